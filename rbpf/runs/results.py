"""A finished run, for interactive use in a notebook, a script, or a shell.

run = rbpf.load("RUN")
run.trajectory, run.covariance, run.map, run.to_dataframe(), run.plot()
"""

from html import escape
from pathlib import Path
from typing import Any, final

from rbpf.errors import InputError
from rbpf.runs.plots import plot_map
from rbpf.runs.reading import RunFolder

#: Entries of summary.json shown for a run in a notebook.
_SHOWN = (
    "frames", "particles", "ate_rmse_m", "path_rmse_m", "ate_sim3_rmse_m", "filter_minus_batch_rmse_m", "ms_per_frame",
)  # fmt: skip


@final
class Results(RunFolder):
    """A run folder, see `RunFolder`, with tables and figures."""

    def to_dataframe(self) -> Any:
        """A pandas DataFrame, one row per frame: times, position, diagnostics and timings."""
        try:
            import pandas
        except ImportError as error:
            raise InputError("a data frame needs pandas, which is not installed: pip install pandas") from error
        position = dict(zip(("x_m", "y_m", "z_m"), self.trajectory.positions.T, strict=True))
        columns = {"stamp_ns": self.path.stamps_ns, **position}
        for name in ("diagnostics.csv", "timings.csv"):
            columns |= {key: v for key, v in self.table(name).items() if key not in ("step", "stamp_ns")}
        return pandas.DataFrame(columns)

    def plot(self) -> Any:
        """A matplotlib figure of the path and the map with 3σ ellipses."""
        return plot_map(self)

    def __repr__(self) -> str:
        shown = ", ".join(f"{name} {value}" for name, value in self._figures())
        return f"<run {self.folder}: {self.system}, {self.name}; {shown}>"

    def _repr_html_(self) -> str:
        """For notebooks: the run's main figures."""
        rows = [("system", self.system), ("recording", self.name), *self._figures()]
        cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>" for name, value in rows)
        return f"<table><caption>{escape(str(self.folder))}</caption>{cells}</table>"

    def _figures(self) -> list[tuple[str, str]]:
        found = [(name, self.summary[name]) for name in _SHOWN if name in self.summary]
        found = [(n, v.get("median") if isinstance(v, dict) else v) for n, v in found]
        return [(name, f"{value:.4g}" if isinstance(value, float) else str(value)) for name, value in found]


def load(folder: Path | str) -> Results:
    """Opens a run folder. Raises InputError: it is not a run folder, of another version, or damaged."""
    return Results.open(folder)
