"""Compiles all kernels into the cache: `python -m rbpf.kernels`, once after installation."""

from importlib import import_module

from rbpf.kernels import compile_once

compile_once(lambda: print("compiling the kernels, which takes a minute and is done once …"))
for name in (
    "range_bearing_kernels",
    "camera_kernels",
    "constellation_kernel",
    "patch_kernels",
    "patch_correlation_kernels",
    "patch_refinement_kernels",
    "patch_warp_kernels",
    "corner_kernels",
    "view_kernels",
):
    import_module(f"rbpf.sensors.{name}")
import_module("rbpf.motion.stereo_kernels")
import_module("rbpf.motion.stereo_triple_kernels")
import_module("rbpf.validation.simulation.raster_kernel")
