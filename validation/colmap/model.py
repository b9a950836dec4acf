"""Conversion of cameras, pixels and poses to COLMAP's; a reconstruction from a path, a map and observations; its images.

COLMAP's poses are camera-from-world and its top-left pixel's centre is (0.5, 0.5); here poses are world-from-camera and
it is (0, 0). The half pixel is added and subtracted in this module only.
J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (2016).

In a reconstruction, image t + 1 is frame t (images 2t + 1 and 2t + 2 on one rig for a stereo pair), and point j + 1 is
row j of the map.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from rbpf.lie import SE3, Array
from rbpf.runs.files import prepare_folder
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import ImageSequence, Part, Topics, open_images, open_stereo
from rbpf.sensors.readers.images.decoding import FileImages
from rbpf.sensors.readers.images.sequence import Source
from rbpf.sensors.readers.part import Chosen
from rbpf.validation.gtsam.observations import ObservationTable

HALF_PX = 0.5  #: Added to our pixels to obtain COLMAP's.
LEFT, RIGHT = 1, 2  #: Numbers of the cameras.
OVER_IMAGES = "mono", "stereo"  #: Systems that use images.
Names = dict[tuple[int, int], str]  #: Names of images by frame and side.
_UPRIGHT = 1  #: Value of the EXIF orientation tag of an image that is not rotated.


def to_colmap_camera(camera: Pinhole, camera_id: int = 1) -> Any:
    """The `pycolmap.Camera` equal to our camera, with a known focal length.

    PINHOLE without distortion; OPENCV with k1, k2, p1, p2; FULL_OPENCV, with denominator 1, with k3; OPENCV_FISHEYE
    for an equidistant lens.
    """
    import pycolmap

    lens = list(camera.distortion)
    if camera.distortion_model == "equidistant":
        name = "OPENCV_FISHEYE"
    elif lens[4]:
        name, lens = "FULL_OPENCV", [*lens, 0.0, 0.0, 0.0]
    else:
        name, lens = ("OPENCV", lens[:4]) if any(lens) else ("PINHOLE", [])
    params = [camera.fx, camera.fy, camera.cx + HALF_PX, camera.cy + HALF_PX, *lens]
    found = pycolmap.Camera(model=name, width=camera.width, height=camera.height, params=params, camera_id=camera_id)
    found.has_prior_focal_length = True
    return found


def from_colmap_pose(cam_from_world: Any) -> Array:
    """The pose world_from_camera (7,) of a `pycolmap.Rigid3d`."""
    inverse = np.concatenate([cam_from_world.rotation.quat, cam_from_world.translation])
    return SE3.inverse(SE3.normalise(inverse))


def image_name(frame: int, side: int = LEFT) -> str:
    """Name of a frame's image in a model, which identifies it."""
    return f"{'left' if side == LEFT else 'right'}/{frame:06d}.png"


def build_model(
    table: ObservationTable,
    world_from_camera: Array,
    points: Array,
    colours: NDArray[np.uint8] | None = None,
    names: Names | None = None,
) -> Any:
    """A `pycolmap.Reconstruction` of observations of T frames; the right pixel of a pair becomes an observation of its own.

    `world_from_camera` (T, 7) are poses of the (left) camera; `points` (L, 3), in the order of the table's names, are
    grey without `colours` (L, 3) RGB. Images without an entry in `names`, by frame and side, are left out; by default
    all are named by `image_name`.
    """
    import pycolmap

    model, camera = pycolmap.Reconstruction(), table.camera
    stereo = isinstance(camera, RectifiedStereo)
    sides = (LEFT, RIGHT) if stereo else (LEFT,)
    pixels = {LEFT: table.z[:, :2], RIGHT: table.z[:, [-1, 1]]}
    if names is None:
        names = {(step, side): image_name(step, side) for step in range(len(world_from_camera)) for side in sides}
    rig, sensors = pycolmap.Rig(rig_id=1), {}
    for side in sides:
        model.add_camera(to_colmap_camera(camera.camera if isinstance(camera, RectifiedStereo) else camera, side))
        sensors[side] = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, side)
    rig.add_ref_sensor(sensors[LEFT])
    if isinstance(camera, RectifiedStereo):
        # In the right image a point at depth z is baseline · f / z further left.
        shift = np.array([-camera.baseline_m, 0.0, 0.0])
        rig.add_sensor(sensors[RIGHT], pycolmap.Rigid3d(pycolmap.Rotation3d(), shift))
    model.add_rig(rig)
    tracks: list[list[Any]] = [[] for _ in points]
    for step, inverse in enumerate(SE3.inverse(world_from_camera)):
        rows = np.flatnonzero(table.steps == step)
        images = [
            pycolmap.Image(
                name=names[step, side],
                keypoints=pixels[side][rows] + HALF_PX,
                camera_id=side,
                image_id=image_id(step, side, stereo),
            )
            for side in sides
            if (step, side) in names
        ]
        if not images:
            continue
        frame = pycolmap.Frame(frame_id=step + 1, rig_id=1)
        for image in images:
            image.frame_id = step + 1
            frame.add_data_id(image.data_id)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(inverse[:4]), inverse[4:])
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(step + 1)
        # An observation is its image and its index among this image's pixels.
        for place, index in enumerate(table.index[rows].tolist()):
            tracks[index] += [pycolmap.TrackElement(image.image_id, place) for image in images]
    grey = np.full((len(points), 3), 128, dtype=np.uint8)
    for point, colour, track in zip(points, grey if colours is None else colours, tracks, strict=True):
        model.add_point3D(point, pycolmap.Track(track), colour)
    model.update_point_3d_errors()
    return model


def image_id(frame: int, side: int = LEFT, stereo: bool = False) -> int:
    """Number of an image in a model."""
    return 2 * frame + side if stereo else frame + 1


def recorded_images(config: Mapping[str, Any]) -> ImageSequence:
    """The images named by a run's config.yaml. Raises InputError: they have been moved."""
    opened = open_stereo if config["system"] == "stereo" else open_images
    topics = Topics.parse(config.get("image_topic"), config.get("truth_topic"))
    return opened(Path(str(config["recording"])), config.get("calibration"), topics=topics, part=Part.of(config))


def lay_out(sequence: ImageSequence, folder: Path, count: int) -> Names:
    """Links to the files of the first images of a recording, or the images as filtered, as PNG files.

    A file is linked under its own name if the system used it unchanged: not from a video or a bag, nor rectified, resized
    or rotated. Missing files are left out. Returns the names as paths below `folder`.
    """
    stereo = sequence.baseline_m is not None
    prefixes = {LEFT: "left/", RIGHT: "right/"} if stereo else {LEFT: ""}
    for prefix in prefixes.values():
        prepare_folder(folder / prefix)
    names: Names = {}
    files = _files(sequence.source, (sequence.camera.width, sequence.camera.height))
    if files is not None:
        for side, paths in zip(prefixes, files, strict=False):
            own = len({path.name for path in paths}) == len(paths)
            for t, path in enumerate(paths[:count]):
                if not path.is_file():
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


def _files(source: Source, size: tuple[int, int]) -> list[list[Path]] | None:
    """The files, of one camera or two, of the images exactly as filtered; None if there are no such files."""
    rows: list[int] | None = None
    if isinstance(source, Chosen):
        rows, source = source.rows.tolist(), source.source
    if not isinstance(source, FileImages):
        return None
    cameras = [list(source.left), *([] if source.right is None else [list(source.right)])]
    for files in cameras:
        try:
            with Image.open(files[0]) as first:
                upright = first.getexif().get(ExifTags.Base.Orientation, _UPRIGHT) == _UPRIGHT
                # A resized image has no file.
                if first.size != size or not upright:
                    return None
        except (OSError, IndexError):
            return None
    return [files if rows is None else [files[row] for row in rows] for files in cameras]
