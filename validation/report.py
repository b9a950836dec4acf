"""One page per run: the figures of summary.json and all pictures; a video stays a file beside it."""

import base64
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, select_autoescape

from rbpf.validation.files import write_text


def write_report(out: Path, entries: dict[str, Any], pictures: list[str], video: str | None = None) -> Path:
    """Writes `report.html` into a run's folder and returns its path."""
    environment = Environment(
        loader=PackageLoader("rbpf.validation", "templates"), autoescape=select_autoescape()
    )
    images = [(Path(name).stem, base64.b64encode((out / name).read_bytes()).decode()) for name in pictures]
    page = environment.get_template("report.html").render(
        entries=_flat(entries), images=images, title=entries["recording"], video=video
    )
    path = out / "report.html"
    write_text(path, page)
    return path


def _flat(entries: dict[str, Any]) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in entries.items():
        if isinstance(value, dict):
            rows.extend((f"{name}.{inner}", _shown(item)) for inner, item in value.items())
        else:
            rows.append((name, _shown(value)))
    return rows


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
