"""The images of a run beside its COLMAP model, under the names that the model gives them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from rbpf.runs.files import prepare_folder
from rbpf.sensors.readers import ImageSequence, Part, Topics, open_images, open_stereo
from rbpf.sensors.readers.images.decoding import FileImages
from rbpf.sensors.readers.images.sequence import Source
from rbpf.sensors.readers.part import Chosen
from rbpf.validation.colmap.model import LEFT, RIGHT, image_name

OVER_IMAGES = "mono", "stereo"
"""Systems whose runs have images."""
Names = dict[tuple[int, int], str]
"""Names of images by frame and side."""

_UPRIGHT = 1
"""What a photo's tag of its orientation says where it is not turned."""


def recorded_images(config: Mapping[str, Any]) -> ImageSequence:
    """The images that a run's config.yaml names.

    Raises:
        InputError: they are not where they were.
    """
    opened = open_stereo if config["system"] == "stereo" else open_images
    topics = Topics.parse(config.get("image_topic"), config.get("truth_topic"))
    return opened(Path(str(config["recording"])), config.get("calibration"), topics=topics, part=Part.of(config))


def lay_out(sequence: ImageSequence, folder: Path, count: int) -> Names:
    """Links to the files of the first images of a recording, or the images as they were filtered, as PNG files.

    A file is linked to under its own name where the system saw it as it is: not one of a video or a bag, rectified, resized
    or turned. A missing one is left out.

    Returns:
        Name of each image, as a path below `folder`.

    Raises:
        InputError: the folder cannot be written to.
    """
    stereo = sequence.baseline_m is not None
    prefixes = {LEFT: "left/", RIGHT: "right/"} if stereo else {LEFT: ""}
    for prefix in prefixes.values():
        prepare_folder(folder / prefix)
    names: Names = {}
    files = _files(sequence.source, (sequence.camera.width, sequence.camera.height))
    if files is not None:
        for side, paths in zip(prefixes, files, strict=False):
            own = len({path.name for path in paths if path is not None}) == len([*filter(None, paths)])
            for t, path in enumerate(paths[:count]):
                if path is None or not path.is_file():
                    continue
                names[t, side] = prefixes[side] + (path.name if own else f"{t:06d}{path.suffix}")
                link = folder / names[t, side]
                link.unlink(missing_ok=True)
                link.symlink_to(path.resolve())
        return names
    for t, frame in zip(range(count), sequence.frames(), strict=False):
        for side, image in zip(prefixes, (frame.image, frame.right), strict=False):
            if image is not None:
                names[t, side] = image_name(t, side) if stereo else f"{t:06d}.png"
                Image.fromarray(image).save(folder / names[t, side])
    return names


def _files(source: Source, size: tuple[int, int]) -> list[list[Path | None]] | None:
    """The files of one camera or two that hold the images as they are filtered; None where there are none."""
    rows: list[int] | None = None
    if isinstance(source, Chosen):
        rows, source = source.rows.tolist(), source.source
    if not isinstance(source, FileImages):
        return None
    cameras: list[list[Path | None]] = [list(source.left), *([] if source.right is None else [list(source.right)])]
    for files in cameras:
        try:
            with Image.open(next(path for path in files if path is not None)) as first:
                upright = first.getexif().get(ExifTags.Base.Orientation, _UPRIGHT) == _UPRIGHT
                # An image made smaller is no file.
                if first.size != size or not upright:
                    return None
        except (OSError, StopIteration):
            return None
    return [files if rows is None else [files[row] for row in rows] for files in cameras]
