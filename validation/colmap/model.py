"""A COLMAP reconstruction made of a path, a map and its sightings: cameras, images, points, tracks.

Image t + 1 is frame t (of a stereo pair, images 2t + 1 and 2t + 2 on one rig), point j + 1 is row j of the map.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.validation.colmap.frames import HALF_PX, to_colmap_camera, to_colmap_pose
from rbpf.validation.gtsam.camera_data import Sightings

LEFT, RIGHT = 1, 2
"""Numbers of the cameras."""


def image_name(frame: int, side: int = LEFT) -> str:
    """Name of a frame's image in a model, by which it is found again."""
    return f"{'left' if side == LEFT else 'right'}/{frame:06d}.png"


def build_model(
    table: Sightings, world_from_camera: Array, points: Array, colours: NDArray[np.uint8] | None = None
) -> Any:
    """A `pycolmap.Reconstruction`.

    Args:
        table: sightings of T frames; the right pixel of a stereo pair becomes an observation of its own.
        world_from_camera: (T, 7) of the (left) camera.
        points: (L, 3), in the order of the table's names.
        colours: (L, 3) RGB; by default grey.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    stereo = isinstance(table.camera, RectifiedStereo)
    if isinstance(table.camera, RectifiedStereo):
        _add_rig(model, table.camera)
    else:
        model.add_camera_with_trivial_rig(to_colmap_camera(table.camera, LEFT))
    pixels = _pixels(table)
    for frame, pose in enumerate(world_from_camera):
        rows = np.flatnonzero(table.steps == frame)
        images = [
            pycolmap.Image(
                name=image_name(frame, side),
                keypoints=pixels[side - 1][rows] + HALF_PX,
                camera_id=side,
                image_id=image_id(frame, side, stereo),
            )
            for side in sides(stereo)
        ]
        if stereo:
            _add_pair(model, frame + 1, images, pose)
        else:
            model.add_image_with_trivial_frame(images[0], to_colmap_pose(pose))
    _add_points(model, table, points, colours, stereo)
    return model


def sides(stereo: bool) -> tuple[int, ...]:
    """The cameras of a frame."""
    return (LEFT, RIGHT) if stereo else (LEFT,)


def image_id(frame: int, side: int = LEFT, stereo: bool = False) -> int:
    """Number of an image in a model."""
    return 2 * frame + side if stereo else frame + 1


def _pixels(table: Sightings) -> list[Array]:
    if isinstance(table.camera, RectifiedStereo):
        return [table.z[:, :2], table.z[:, [2, 1]]]
    return [table.z]


def _add_points(
    model: Any, table: Sightings, points: Array, colours: NDArray[np.uint8] | None, stereo: bool
) -> None:
    import pycolmap

    grey = np.full((len(points), 3), 128, dtype=np.uint8)
    colours = grey if colours is None else colours
    tracks: list[list[Any]] = [[] for _ in points]
    places = dict[int, int]()
    for step, index in zip(table.steps.tolist(), table.index.tolist(), strict=True):
        place = places.get(step, 0)
        places[step] = place + 1
        tracks[index] += [
            pycolmap.TrackElement(image_id(step, side, stereo), place) for side in sides(stereo)
        ]
    for index, (point, colour) in enumerate(zip(points, colours, strict=True)):
        track = pycolmap.Track(tracks[index])
        model.add_point3D_with_id(index + 1, pycolmap.Point3D(xyz=point, color=colour))
        for element in track.elements:
            model.add_observation(index + 1, element)


def _add_rig(model: Any, pair: RectifiedStereo) -> None:
    import pycolmap

    for side in (LEFT, RIGHT):
        model.add_camera(to_colmap_camera(pair.camera, side))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(_sensor(LEFT))
    # A point at depth z is baseline · f / z further left in the right image.
    right_from_left = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-pair.baseline_m, 0.0, 0.0]))
    rig.add_sensor(_sensor(RIGHT), right_from_left)
    model.add_rig(rig)


def _add_pair(model: Any, frame_id: int, images: list[Any], pose: Array) -> None:
    import pycolmap

    frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
    for image in images:
        image.frame_id = frame_id
        frame.add_data_id(image.data_id)
    frame.rig_from_world = to_colmap_pose(pose)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(frame_id)


def _sensor(camera_id: int) -> Any:
    import pycolmap

    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
