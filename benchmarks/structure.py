"""Size of the code for a newcomer: lines, files, folders, import cycles, and the files opened in common tasks.

    python benchmarks/structure.py [FOLDER]     of the checkout in FOLDER, by default this one

It reads the source as text and as syntax trees without importing it, so that two checkouts can be compared.
"""

import ast
import json
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOMS = ("rbpf", "sensors", "motion", "maps", "validation")
"""The installed folders."""

TASKS = Path(__file__).with_name("tasks.json")
"""Files opened in the course of a task, as found by doing it."""


def tracked(root: Path) -> list[Path]:
    """The Python files tracked by git, without links."""
    listed = subprocess.run(
        ["git", "-C", root, "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.py"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    paths = [root / name for name in listed.stdout.split("\0") if name]
    return [path for path in paths if path.is_file() and not path.is_symlink()]


def installed(root: Path, paths: list[Path]) -> list[Path]:
    """Those of the installed package."""
    return [path for path in paths if path.relative_to(root).parts[0] in ROOMS]


def module_of(root: Path, path: Path) -> str:
    """Its dotted name: sensors/features/sift.py is rbpf.sensors.features.sift."""
    parts = path.relative_to(root).with_suffix("").parts
    parts = parts if parts[0] == "rbpf" else ("rbpf", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def called_once(trees: dict[str, ast.Module]) -> tuple[int, int]:
    """Number of private functions named at one place besides their definition, and of all private functions."""
    named, defined = Counter(), []
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("_") and not node.name.startswith("__"):
                if not any(isinstance(d, ast.Name) and d.id == "njit" for d in node.decorator_list):
                    defined.append((module, node.name))
            elif isinstance(node, ast.Name):
                named[module, node.id] += 1
            elif isinstance(node, ast.Attribute):
                named[module, node.attr] += 1
    return sum(named[key] == 1 for key in defined), len(defined)


def imports(module: str, tree: ast.Module, modules: set[str]) -> Iterator[str]:
    """Imported modules of the package: at the top, in functions, and for types only."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            while name not in modules and "." in name:
                name = name.rpartition(".")[0]
            if name in modules and name != module:
                yield name


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected groups of modules (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in graph[module]:
            if other not in index:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], index[other])
        if low[module] == index[module]:
            at = stack.index(module)
            group = stack[at:]
            del stack[at:]
            if len(group) > 1:
                found.append(sorted(group))

    sys.setrecursionlimit(10_000)
    for module in graph:
        if module not in index:
            visit(module)
    return found


def public_names(trees: dict[str, ast.Module]) -> int:
    """Functions, classes and constants of modules whose names have no underscore in front."""
    count = 0
    for tree in trees.values():
        for node in tree.body:
            names = []
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names = [node.name]
            elif isinstance(node, ast.Assign):
                names = [target.id for target in node.targets if isinstance(target, ast.Name)]
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                names = [node.target.id]
            count += sum(not name.startswith("_") for name in names)
    return count


def measure(root: Path) -> dict[str, object]:
    """Measures all figures of a checkout."""
    paths = tracked(root)
    package = installed(root, paths)
    tests = [path for path in paths if path.relative_to(root).parts[0] == "tests"]
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in paths}
    trees = {module_of(root, path): ast.parse(path.read_text(encoding="utf-8")) for path in package}
    packages = {m for m in trees if any(other.startswith(f"{m}.") for other in trees)}
    graph = {m: set(imports(m, tree, set(trees))) for m, tree in trees.items()}
    entries: dict[str, set[str]] = defaultdict(set)
    for path in package:
        parts = path.relative_to(root).parts
        for depth in range(1, len(parts)):
            if parts[depth] != "__init__.py":
                entries["/".join(parts[:depth])].add(parts[depth])
    once, private = called_once(trees)
    comments = sum(line.lstrip().startswith("#") for path in package for line in path.read_text("utf-8").splitlines())
    groups = circles({m: imported - packages for m, imported in graph.items()})
    return {
        "lines of the package": sum(lines[path] for path in package),
        "files of the package": len(package),
        "lines of the tests": sum(lines[path] for path in tests),
        "files of the tests": len(tests),
        "lines of examples, benchmarks and docs": sum(lines.values()) - sum(lines[path] for path in (*package, *tests)),
        "lines that are comments": comments,
        "private functions": private,
        "private functions named once": once,
        "circles of imports, for types too": len(groups),
        "modules in them": sum(map(len, groups)),
        "public names": public_names(trees),
        "fullest folders": dict(Counter({f: len(e) for f, e in entries.items()}).most_common(6)),
        "longest files": {
            str(path.relative_to(root)): lines[path] for path in sorted(package, key=lambda p: -lines[p])[:4]
        },
    }


def main() -> None:
    """Prints the figures, and the number of files opened in each task."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1]).resolve()
    for name, value in measure(root).items():
        print(f"{name:42} {value}")
    tasks = root / TASKS.relative_to(Path(__file__).parents[1])
    if tasks.exists():
        for task, files in json.loads(tasks.read_text()).items():
            missing = [name for name in files if not (root / name).exists()]
            print(f"{task:42} {len(files)}{f' ({missing} do not exist)' if missing else ''}")


if __name__ == "__main__":
    main()
