"""`rbpf doctor` and `rbpf completion`: about the installation itself."""

import sys
import time
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from typing import Literal

import tyro

from rbpf.cli.compiling import cached, compile_kernels, kernel_modules
from rbpf.cli.options import Printed
from rbpf.cli.showing import answer, table
from rbpf.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Doctor(Printed):
    """Say what is installed, in which versions, which parts work here; compile the kernels."""

    compile: bool = True  #: compile the kernels, once, so that the first run need not.

    def __call__(self) -> None:
        from rbpf.validation.installation import machine, parts, versions

        found, tried, libraries, modules = machine(), parts(), versions(), kernel_modules()
        compiled: dict[str, float] = {}
        if self.compile:
            started = time.perf_counter()
            compile_kernels(every=True)
            compiled = {"kernels_seconds": round(time.perf_counter() - started, 1)}
        missing = [name for name in modules if not cached(name)]
        broken = [part for part in tried if part.needed and not part.works]
        entries = {
            **found,
            "libraries": libraries,
            "parts": [part._asdict() for part in tried],
            **compiled,
            "kernels_missing": missing,
            "works": not broken,
        }
        fails = {True: "BROKEN", False: "not installed"}
        lines = {part.name: f"{'works' if part.works else fails[part.needed]}: {part.says}" for part in tried}
        known = {name: number or "missing" for name, number in libraries.items()}
        kernels = f"{len(modules) - len(missing)} of {len(modules)} compiled"
        # The result first, and what to do.
        names = ", ".join(part.name for part in broken)
        absent = ", ".join(part.name for part in tried if not part.works)
        optional = f"; not installed, and only needed for what its name says: {absent}" if absent else ""
        result = f"{names}: needed, and broken here" if broken else f"all that every run needs works{optional}"
        todo = "what to do stands in its line" if broken else "to begin: rbpf demo"
        answer(entries, self.json, result, *table({**found, **known, **lines, "kernels": kernels}, 26), todo)
        if broken:
            raise InputError(f"{result}; see above")


#: The last line for zsh is one for a file in its `fpath`; evaluated, it would complete nothing.
_ZSH = (
    '\n_tyro_rbpf "$@"\n',
    '\nif [ "$funcstack[1]" = "_rbpf" ]; then _tyro_rbpf "$@"; else compdef _tyro_rbpf rbpf; fi\n',
)


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Print what makes a shell complete the commands and options of rbpf: eval "$(rbpf completion bash)"."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]  #: for which it is.

    def __call__(self) -> None:
        from rbpf.cli import APP, PROGRAM

        printed = StringIO()
        with suppress(SystemExit), redirect_stdout(printed):
            APP.call(["--tyro-print-completion", self.shell], PROGRAM)
        sys.stdout.write(printed.getvalue().replace(*_ZSH))
