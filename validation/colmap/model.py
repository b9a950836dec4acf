"""COLMAP's cameras, pixels and poses in ours, and a reconstruction made of a path, a map and its observations.

COLMAP writes poses as camera-from-world and puts the centre of the top-left pixel at (0.5, 0.5); here poses are
world-from-camera and it is at (0, 0). The half pixel is added and taken away in this module and nowhere else.
J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (2016).

In a reconstruction, image t + 1 is frame t (of a stereo pair, images 2t + 1 and 2t + 2 on one rig), point j + 1 is row j
of the map.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.gtsam.observations import ObservationTable

HALF_PX = 0.5
"""Added to our pixels it gives COLMAP's."""
LEFT, RIGHT = 1, 2
"""Numbers of the cameras."""


def camera_model(camera: Pinhole) -> tuple[str, list[float]]:
    """Name and parameters of COLMAP's model that is exactly our camera.

    PINHOLE without distortion; OPENCV with k1, k2, p1, p2; FULL_OPENCV, whose denominator is left at 1, with k3;
    OPENCV_FISHEYE where it is equidistant.
    """
    plain = [camera.fx, camera.fy, camera.cx + HALF_PX, camera.cy + HALF_PX]
    if camera.distortion_model == "equidistant":
        return "OPENCV_FISHEYE", [*plain, *camera.distortion]
    *four, k3 = camera.distortion
    if k3:
        return "FULL_OPENCV", [*plain, *four, k3, 0.0, 0.0, 0.0]
    return ("OPENCV", [*plain, *four]) if any(four) else ("PINHOLE", plain)


def to_colmap_camera(camera: Pinhole, camera_id: int = 1) -> Any:
    """A `pycolmap.Camera` with a known focal length."""
    import pycolmap

    name, params = camera_model(camera)
    return pycolmap.Camera(
        model=name,
        width=camera.width,
        height=camera.height,
        params=params,
        camera_id=camera_id,
        has_prior_focal_length=True,
    )


def to_colmap_pose(world_from_camera: ArrayLike) -> Any:
    """The `pycolmap.Rigid3d` cam_from_world of a pose (7,)."""
    import pycolmap

    inverse = SE3.inverse(np.asarray(world_from_camera, dtype=float))
    return pycolmap.Rigid3d(pycolmap.Rotation3d(inverse[:4]), inverse[4:])


def from_colmap_pose(cam_from_world: Any) -> Array:
    """The pose world_from_camera (7,) of a `pycolmap.Rigid3d`."""
    inverse = np.concatenate([cam_from_world.rotation.quat, cam_from_world.translation])
    return SE3.inverse(SE3.normalise(inverse))


def image_name(frame: int, side: int = LEFT) -> str:
    """Name of a frame's image in a model, by which it is found again."""
    return f"{'left' if side == LEFT else 'right'}/{frame:06d}.png"


def build_model(
    table: ObservationTable,
    world_from_camera: Array,
    points: Array,
    colours: NDArray[np.uint8] | None = None,
    names: Mapping[tuple[int, int], str] | None = None,
) -> Any:
    """A `pycolmap.Reconstruction`.

    Args:
        table: observations of T frames; the right pixel of a stereo pair becomes an observation of its own.
        world_from_camera: (T, 7) of the (left) camera.
        points: (L, 3), in the order of the table's names.
        colours: (L, 3) RGB; by default grey.
        names: of the images, by frame and side; others are left out. By default all, as `image_name` calls them.
    """
    import pycolmap

    model, camera = pycolmap.Reconstruction(), table.camera
    stereo = isinstance(camera, RectifiedStereo)
    sides = (LEFT, RIGHT) if stereo else (LEFT,)
    pixels = {LEFT: table.z[:, :2], RIGHT: table.z[:, [-1, 1]]}
    if isinstance(camera, RectifiedStereo):
        sensors = {side: pycolmap.sensor_t(pycolmap.SensorType.CAMERA, side) for side in sides}
        for side in sides:
            model.add_camera(to_colmap_camera(camera.camera, side))
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(sensors[LEFT])
        # A point at depth z is baseline · f / z further left in the right image.
        shift = np.array([-camera.baseline_m, 0.0, 0.0])
        rig.add_sensor(sensors[RIGHT], pycolmap.Rigid3d(pycolmap.Rotation3d(), shift))
        model.add_rig(rig)
    else:
        model.add_camera_with_trivial_rig(to_colmap_camera(camera, LEFT))
    for step, pose in enumerate(world_from_camera):
        rows = np.flatnonzero(table.steps == step)
        images = [
            pycolmap.Image(
                name=image_name(step, side) if names is None else names[step, side],
                keypoints=pixels[side][rows] + HALF_PX,
                camera_id=side,
                image_id=image_id(step, side, stereo),
            )
            for side in sides
            if names is None or (step, side) in names
        ]
        if not stereo or not images:
            for image in images:
                model.add_image_with_trivial_frame(image, to_colmap_pose(pose))
            continue
        frame = pycolmap.Frame(frame_id=step + 1, rig_id=1)
        for image in images:
            image.frame_id = step + 1
            frame.add_data_id(image.data_id)
        frame.rig_from_world = to_colmap_pose(pose)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(step + 1)
    # Points with their tracks: an observation is its image and its place among this image's pixels.
    grey = np.full((len(points), 3), 128, dtype=np.uint8)
    tracks: list[list[Any]] = [[] for _ in points]
    places = dict[int, int]()
    for step, index in zip(table.steps.tolist(), table.index.tolist(), strict=True):
        place = places.get(step, 0)
        places[step] = place + 1
        tracks[index] += [
            pycolmap.TrackElement(image_id(step, side, stereo), place)
            for side in sides
            if names is None or (step, side) in names
        ]
    for index, (point, colour) in enumerate(zip(points, grey if colours is None else colours, strict=True)):
        model.add_point3D_with_id(index + 1, pycolmap.Point3D(xyz=point, color=colour))
        for element in tracks[index]:
            model.add_observation(index + 1, element)
    model.update_point_3d_errors()
    return model


def image_id(frame: int, side: int = LEFT, stereo: bool = False) -> int:
    """Number of an image in a model."""
    return 2 * frame + side if stereo else frame + 1
