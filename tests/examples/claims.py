"""What each example shows: bounds of its figures, or a function of its name that is given them."""

from typing import Any

import pytest

NONE, ALL = (0.0, 0.0), (1.0, 1.0)
BOUNDS: dict[str, dict[str, tuple[float, float]]] = {
    "against_colmap": {
        "run: share_registered": (0.9, 1.0),
        "run: ate_rmse_m": (0.0, 0.02),
        "COLMAP's own error [m]": (0.0, 0.01),
        "run: surface_median_m": (0.0, 0.1),
    },
    "checkpoint": {"same": ALL, "refused": ALL},
    "fault_matrix": {
        "tracebacks": NONE,
        "resumed as uninterrupted": ALL,
        "mono: none: as without": (0.0, 0.02),
        "stereo: none: as without": (0.0, 0.02),
    },
    "fused_kernel": {"findings": NONE, "difference": (0.0, 1e-6), "speedup": (1.0, 1e3)},
    "mono_blackouts": {
        "blackouts": (2.0, 1e3),
        "recovered": ALL,
        "wrong": NONE,
        "median error a second later [m]": (0.0, 0.03),
    },
    "mono_comes_back": {"before": (0.2, 1.0), "after": (0.0, 0.25), "wrong": NONE},
    "mono_desk": {"ratio": (0.9, 2.0), "ratio_joint": (0.9, 2.0), "nees": (0.5, 2.5), "nees_joint": (0.5, 2.0)},
    "mono_loop": {"sub-maps": (0.001, 0.04), "batch so far": (0.001, 0.02), "batch": (0.001, 0.02)},
    "mono_video": {"frames_tracked": (20.0, 20.0), "ate_rmse_m": (0.0, 0.02)},
    "own_landmark": {"findings": NONE, "located": (25.0, 1e3), "map": (0.0, 0.5), "path": (0.0, 0.2)},
    "gps_imu": {"rmse": (0.0, 0.6), "gone": (0.0, 6.0), "nees": (0.5, 2.0), "least": (0.5, 2.0), "findings": NONE},
    "beyond_gaussians": {
        "stochastic volatility, rbpf: off": (0.0, 0.05),
        "stochastic volatility, rbpf: evidence": (-0.3, 0.3),
        "growth, rbpf: off": (0.0, 0.6),
        "growth, rbpf: evidence": (-1.0, 1.0),
    },
    "grid_slam": {"off": (0.0, 0.15), "place": (0.0, 0.15), "evidence": (-0.7, 0.7)},
    "jump_markov": {"off": (0.0, 0.12), "evidence": (-0.5, 0.5)},
    "stochastic_volatility": {"off_exact": (0.0, 0.05), "evidence": (-1.0, 1.0), "error": (0.2, 0.6)},
    "range_only_beacons": {"promoted": (5.0, 5.0), "map": (0.0, 0.3), "path": (0.0, 0.2), "from_batch": (0.0, 0.2)},
    "soak": {
        "camera, resident_mb": (0.9, 1.1),
        "robot, resident_mb": (0.9, 1.1),
        "camera, held_kb": (0.0, 1.1),
        "robot, held_kb": (0.0, 2.5),  # in so few frames it has forgotten nothing yet
        "camera, error_m": (0.0, 1.5),
        "robot, error_m": (0.0, 1.5),
    },
    "stereo_lab": {"ate_rmse_m": (0.0, 0.1), "landmarks_mean_per_particle": (20.0, 1e6)},
}
"""Lowest and highest by example and figure."""


def against_batch(figures: dict[str, float]) -> None:
    assert figures["300 particles"] < figures["10 particles"]


def consistency_runs(figures: dict[str, float]) -> None:
    sampled = "monocular, 20 particles, start sampled (known points as landmarks)"
    assert figures[sampled] > 2.0 * figures["monocular, 20 particles, as it is"]
    assert figures["range-bearing, 10 particles"] > figures["range-bearing, 40 particles"]


def custom_sensor(figures: dict[str, float]) -> None:
    assert figures["findings"] == 0
    assert figures["filter"] < 0.25 * figures["odometry"]
    assert 0.8 < figures["nis_per_dof"] < 1.25


def error_causes(figures: dict[str, float]) -> None:
    assert figures["batch started from the filter"] == pytest.approx(figures["batch"], rel=1e-3)
    assert figures["10× particles"] < figures["as it is"] * 1.5


def error_ratios(figures: dict[str, float]) -> None:
    assert figures.keys() == {"simulated_robot", "rendered_desk"}
    assert all(0.8 < ratio < 6.0 for ratio in figures.values())


def joint_map(figures: dict[str, float]) -> None:
    assert 0.6 < figures["joint, 20 particles, window 1"] < 1.6
    assert figures["joint, 20 particles, window 1"] < 1.25 * figures["joint EKF"]
    assert 0.3 < figures["stereo joint, 50 particles: NEES"] < 2.0
    assert 0.8 < figures["stereo joint, 50 particles: map"] < 1.25


def hypotheses(figures: dict[str, float]) -> None:
    assert figures["4 hypotheses"] == 1.0
    assert figures["1 hypotheses"] < 1.0


def lab_images(figures: dict[str, dict[str, float]]) -> None:
    clear, dim = figures.values()
    assert dim["share matched, left to right"] < 0.9 * clear["share matched, left to right"]
    assert dim["disparity against the truth, px"] > 1.3 * clear["disparity against the truth, px"]
    assert 0.3 < dim["share matched, frame to frame"] + dim["share matched, left to right"] < 1.4
    assert dim["stereo matches"] > 50.0


def mono_realism(figures: dict[str, float]) -> None:
    assert 0.8 < figures["rendered desk"] <= 1.0
    assert figures["rendered desk"] <= figures["rendered desk, perfect pictures"] + 0.05


def motion_evidence(figures: dict[str, Any]) -> None:
    turns, straight = figures.values()
    assert turns.difference > 3.0 * turns.error
    assert straight.difference < -2.0 * straight.error


def own_proposal(figures: dict[float, tuple[float, float]]) -> None:
    errors, sizes = zip(*figures.values(), strict=True)
    assert max(errors) < 0.15
    assert sizes[0] > sizes[1] > sizes[2]


def reproduce_e06(figures: dict[str, float]) -> None:
    assert {name.split(":")[0] for name in figures} == {f"Fig. {k}" for k in range(2, 10)}

    def of(text: str) -> float:
        (value,) = [value for name, value in figures.items() if text in name]
        return value

    assert of("processor time per frame") < 1.5
    assert of("choice of what to look for") < 0.2
    assert of("landmarks of a flat desk") < 0.03
    assert of("observations per frame") > 20
    assert of("frames in which the camera was lost") == 0
    assert of("epipolar lines longer than 2 px") >= 3
    assert of("distance of what is found from its epipolar line") < 1.0
    assert of("epipolar constraint against none") < 0.5
    assert of("first observation: divergence") > 5.0  # half the resolution sees half the parallax


def reproduce_s05(figures: dict[str, float]) -> None:
    assert figures["path, filter"] < 0.1
    assert figures["path, best particle"] < 0.1
    assert figures["map, filter, aligned"] < figures["map, odometry, aligned"] + 0.05
    assert figures["map, best particle, aligned"] < 0.2
    assert 0.0 < figures["mean ms of an update"] < 1e3 * figures["mean seconds per pair"]
    assert figures["mean seconds per pair"] < figures["the paper's"]


def range_bearing_robot(figures: dict[str, float]) -> None:
    assert figures["path_rmse_m"] < 0.5 * figures["odometry_path_rmse_m"]
    assert figures["batch_path_rmse_m"] < 1.5 * figures["path_rmse_m"]


def smoothing(figures: dict[str, float]) -> None:
    assert figures["ancestral paths"] < 0.5 * figures["filter"]
    assert figures["backward"] < 0.5 * figures["filter"]


def stereo_revisit(figures: dict[str, float]) -> None:
    assert len(figures) == 4
    for way in ("there", "there and back"):
        recording = f"simulated lab, seed 0, {way}"
        # The quick path is too short for the map to bring much.
        assert figures[f"{recording}: filter"] < 1.2 * figures[f"{recording}: odometry"]


def stereo_overconfidence(figures: dict[str, float]) -> None:
    default = "default: prior, T_l = 4, updates within 16.3"
    clipped = "what is clipped does not update"
    # The quick path is too short for the map to bring much.
    assert figures[f"{default}: error, mm"] < 1.2 * figures["odometry alone: error, mm"]
    assert figures[f"{default}: NEES"] < figures[f"{clipped}: NEES"]


def sweep(figures: dict[str, float]) -> None:
    assert figures["refined three times, 40"] < figures["bootstrap, 10"]


def validate_run(figures: dict[str, str]) -> None:
    assert set(figures) == {"groundtruth", "gtsam"}
    assert set(figures.values()) <= {"trust", "cannot tell"}


def verdict(figures: dict[str, bool]) -> None:
    assert figures and all(figures.values())


def target_tracking(figures: dict[str, dict[str, float]]) -> None:
    bootstrap, marginalised, refined = figures.values()
    for better in (marginalised, refined):
        assert better["position_rmse"] < bootstrap["position_rmse"]
        assert better["spread"] < 0.7 * bootstrap["spread"]


def two_optimisers(figures: dict[str, float]) -> None:
    assert figures["pose_difference_max"] < 1e-4
    assert figures["pose_covariance_error_max"] < 0.05
    assert figures["error_colmap"] == pytest.approx(figures["error_gtsam"], rel=1e-6)
