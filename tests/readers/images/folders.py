"""Small recordings of every format, written into a folder."""

from pathlib import Path

import cv2
import numpy as np

from rbpf.lie import SE3

WIDTH, HEIGHT = 24, 16
SIZE = (HEIGHT, WIDTH)
CAMERA = {"fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 7.5, "width": WIDTH, "height": HEIGHT}


def grey(level, size=SIZE):
    """An image whose mean is about `level` and whose left and right halves differ."""
    image = np.full(size, level, dtype=np.uint8)
    image[:, size[1] // 2 :] += 5
    return image


def write_image(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(path.suffix, image)
    assert done
    path.write_bytes(data.tobytes())


def write_images(folder, names, first=10, size=SIZE):
    for i, name in enumerate(names):
        write_image(folder / name, grey(first + 10 * i, size))


def write_camera(folder, **changes):
    entries = {**CAMERA, **changes}
    path = Path(folder) / "camera.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in entries.items() if v is not None))
    return path


def write_plain(folder, names=("0.png", "1.png", "2.png"), **camera):
    write_images(folder, names)
    write_camera(folder, **camera)
    return folder


def write_tum(folder, stamps=("1.5", "1.6", "1.7"), truth=("1.5 1 2 3 0 0 0 1", "1.7 1 2 4 0 0 1 0")):
    write_images(folder / "rgb", [f"{stamp}.png" for stamp in stamps])
    lines = ["# color images", "# timestamp filename", *(f"{stamp} rgb/{stamp}.png" for stamp in stamps)]
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(truth) + "\n")
    write_camera(folder)
    return folder


EUROC_NS = (1403636579763555584, 1403636579813555456, 1403636579863555584)
CAM0 = SE3.from_ypr(np.array([0.1, 0.2, 0.3]), 0.3, -0.2, 1.2)


def sensor_yaml(body_from_sensor, camera=True, **changes):
    entries = {
        "resolution": [WIDTH, HEIGHT],
        "camera_model": "pinhole",
        "intrinsics": [20.0, 21.0, 11.5, 7.5],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [-0.1, 0.01, 0.001, -0.002],
        **changes,
    }
    data = SE3.matrix(body_from_sensor).reshape(-1).tolist()
    text = f"# comment\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {data}\nrate_hz: 20\n"
    return text + "".join(f"{key}: {value}\n" for key, value in entries.items() if camera)


def write_asl_camera(folder, body_from_camera, stamps=EUROC_NS, first=10, **changes):
    write_images(folder / "data", [f"{stamp}.png" for stamp in stamps], first)
    (folder / "sensor.yaml").write_text(sensor_yaml(body_from_camera, **changes))
    rows = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)]
    (folder / "data.csv").write_bytes("".join(row + "\r\n" for row in rows).encode())


def write_euroc(folder, **changes):
    write_asl_camera(folder / "mav0" / "cam0", CAM0, **changes)
    return folder


def write_rectified(folder, baseline=0.11, right=EUROC_NS, **changes):
    straight = {"distortion_coefficients": [0.0, 0.0, 0.0, 0.0]}
    write_asl_camera(folder / "mav0" / "cam0", CAM0, **straight)
    beside = SE3.compose(CAM0, np.array([0, 0, 0, 1, baseline, 0, 0.0]))
    write_asl_camera(folder / "mav0" / "cam1", beside, right, 100, **{**straight, **changes})
    return folder


def write_asl_truth(folder, world_from_sensor, stamps, body_from_sensor=None, extra=""):
    folder.mkdir(parents=True, exist_ok=True)
    if body_from_sensor is not None:
        (folder / "sensor.yaml").write_text(sensor_yaml(body_from_sensor, camera=False))
    lines = ["#timestamp, p_RS_R_x [m], ..."]
    for stamp, (qx, qy, qz, qw, *position) in zip(stamps, np.asarray(world_from_sensor).tolist(), strict=True):
        lines.append(",".join(map(str, [stamp, *position, qw, qx, qy, qz])) + extra)
    (folder / "data.csv").write_text("\n".join(lines) + "\n")


P0 = "P0: 20 0 11.5 0 0 21 7.5 0 0 0 1 0\n"
P1 = "P1: 20 0 11.5 -10.8 0 21 7.5 0 0 0 1 0\n"


def write_kitti(folder, count=3, right=True, calib=P0 + P1):
    names = [f"{i:06d}.png" for i in range(count)]
    write_images(folder / "image_0", names)
    if right:
        write_images(folder / "image_1", names, first=100)
    (folder / "calib.txt").write_text(calib)
    (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(count)))
    return folder


def matrix_row(world_from_camera, rows=3):
    return " ".join(map(str, SE3.matrix(world_from_camera)[:rows].reshape(-1).tolist())) + "\n"


def write_seven_scenes(folder, numbers=(0, 1, 4), size=(480, 640)):
    for i, number in enumerate(numbers):
        write_image(folder / f"frame-{number:06d}.color.png", grey(10 + 10 * i, size))
        pose = SE3.matrix(SE3.from_ypr(np.array([number, 2.0, 3.0]), 0.1 * number, 0.2, 0.3))
        text = "".join("\t ".join(map(str, row)) + "\t \r\n" for row in pose.tolist())
        (folder / f"frame-{number:06d}.pose.txt").write_text(text)
    return folder


def write_video(path, count=12, size=(48, 64), codec="MJPG"):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25.0, size[::-1])
    assert writer.isOpened()
    for i in range(count):
        writer.write(np.repeat(grey((10 * i + 5) % 250, size)[..., None], 3, axis=2))
    writer.release()
    write_camera(path.parent, width=size[1], height=size[0])
    return path


def levels(sequence, start=0):
    """Level of the left half of each image, None where there is none."""
    return [None if frame.image is None else int(frame.image[0, 0]) for frame in sequence.frames(start)]
