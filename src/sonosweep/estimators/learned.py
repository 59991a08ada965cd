"""A trained network as an estimator of motion.

Frames are read a few at a time, each is encoded once and each pair compared once, and only the
features of the last frame and the state of the network stay: any length in the same memory.
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import MotionEstimate, MotionEstimator, Progress
from sonosweep.estimators.fit_scan import FittedScan, fit_scan
from sonosweep.estimators.network import MotionNetwork, NetworkOutput, Stepper, WindowNetwork
from sonosweep.estimators.network_input import image_steps, unit_frames
from sonosweep.estimators.shipped import find_weights
from sonosweep.estimators.weights import WeightsInfo, load_weights
from sonosweep.geometry import motion_from_step, step_from_motion
from sonosweep.scan import Scan

Precision = Literal["auto", "bf16", "fp32"]
Device = Literal["auto", "cpu", "cuda"]
OnMaps = Callable[[int, Mapping[str, Tensor]], None]
"""Called with the number of a step and the network's maps of it and those after it."""

BATCH_FRAMES = 8  # read at a time; more is not faster on a CPU


class LearnedEstimator(MotionEstimator):
    """Reads motion off frames with a trained network.

    Args:
        weights: Name of shipped weights, a file, or the folder of a training run.
        precision: Of the arithmetic: ``"bf16"`` (motions change by about 0.5 %) is faster
            where the processor has instructions for it, and ``"auto"`` takes it there.
        device: ``"auto"`` is the GPU if there is one.
        on_maps: What the network can show of each step, such as its attention, goes here.

    Raises:
        FormatError: If there are no such weights, or they are damaged.
        ScanError: If there is no such device.
    """

    info: WeightsInfo
    network: MotionNetwork

    def __init__(
        self,
        weights: str | os.PathLike,
        precision: Precision = "auto",
        device: Device = "auto",
        on_maps: OnMaps | None = None,
    ) -> None:
        self._device = _device(device)
        self._bf16 = precision == "bf16" or (precision == "auto" and _has_bf16(self._device))
        self._on_maps = on_maps
        self._file = find_weights(os.fspath(weights))
        self.network, self.info = load_weights(self._file)
        self.network.eval().to(self._device)
        for layer in self.network.modules():
            if isinstance(layer, torch.nn.Conv2d):  # others know no such order
                layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)

    @property
    def name(self) -> str:
        """The network's name."""
        return self.info.network

    @property
    def arithmetic(self) -> str:
        """Precision and device, such as ``"bf16 on cpu"``."""
        return f"{'bf16' if self._bf16 else 'fp32'} on {self._device.type}"

    def estimate(self, scan: Scan, progress: Progress | None = None) -> MotionEstimate:
        """Return the motion between consecutive frames; tracked poses are never looked at.

        Raises:
            ScanError: If the scan has too few frames, or the weights are not for such frames
                (:mod:`sonosweep.estimators.fit_scan` has the rule), or memory is short.
        """
        self._refuse_short(scan)
        fitted = fit_scan(scan, self.info)
        motions, variances = [], []
        with self._arithmetic():
            for first, output in self._outputs(fitted, progress):
                motions.append(output.motion[0].float().cpu())
                if output.log_variance is not None:
                    variances.append(output.log_variance[0].float().cpu())
                self._show(first, output)
        scale = torch.tensor(self.info.motion_scale, dtype=torch.float64)
        std = (torch.cat(variances).double() / 2).exp() * scale if variances else None
        return MotionEstimate(
            motion=_image_motion(torch.cat(motions).double() * scale, fitted),
            std=None if std is None else _image_std(std, fitted),
            assumptions=(self._provenance(), *fitted.notes),
        )

    def _outputs(
        self, fitted: FittedScan, progress: Progress | None
    ) -> Iterator[tuple[int, NetworkOutput]]:
        """Give the number of a step and what the network says about it and some after it."""
        stepper, total = Stepper(self.network), len(fitted.frames)
        for start in range(0, total, BATCH_FRAMES):
            stored = torch.from_numpy(fitted.frames[start : start + BATCH_FRAMES])
            frames = unit_frames(stored.to(self._device))
            output = stepper.push_many(frames.contiguous(memory_format=torch.channels_last))
            if output is not None:
                yield max(start - 1, 0), output
            if progress is not None:
                progress(start + len(stored), total)

    def _show(self, first: int, output: NetworkOutput) -> None:
        if self._on_maps is None:
            return
        if not output.maps:
            raise ScanError(f"network '{self.name}' has no maps to show: leave out --maps")
        self._on_maps(first, {name: maps[0].float().cpu() for name, maps in output.maps.items()})

    @contextlib.contextmanager
    def _arithmetic(self) -> Iterator[None]:
        precision = torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16)
        try:
            # One context for the whole sweep: weights are rounded once.
            with torch.inference_mode(), precision:
                yield
        except RuntimeError as error:
            if "allocate memory" not in str(error) and "out of memory" not in str(error):
                raise
            raise ScanError(
                f"out of memory for network '{self.name}': use --device cpu, or smaller weights"
            ) from error

    def _refuse_short(self, scan: Scan) -> None:
        window = self.network.window if isinstance(self.network, WindowNetwork) else 2
        if len(scan.frames) < window:
            raise ScanError(
                f"'{scan.name}' has {len(scan.frames)} frames, and network '{self.name}' needs"
                f" {window}"
            )

    def _provenance(self) -> str:
        return (
            f"Motion is what network '{self.name}' learned with weights '{Path(self._file).name}'"
            f" of {self.info.made} ({'bf16' if self._bf16 else 'fp32'}): it holds for tissue,"
            " probes and speeds like those it was trained on."
        )


def _device(name: Device) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise ScanError("there is no GPU that PyTorch can use: leave out --device cuda")
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(name)


def _has_bf16(device: torch.device) -> bool:
    """Say whether bf16 is arithmetic of the device, and not slowly made of other arithmetic."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    known = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return known is not None and bool(known())


def _image_motion(
    center_motion: Float[Tensor, "steps motion=6"], fitted: FittedScan
) -> Float[Tensor, "steps motion=6"]:
    """Return motions of the image from what a network says about the middle of its frames.

    To a network, pixels have the size it was trained on. If they are smaller in truth, shifts
    in plane are smaller and the tilts that the same differences of distance tell are larger.
    """
    across, down = fitted.stretch
    factors = torch.tensor([across, down, 1.0, 1 / down, 1 / across, 1.0], dtype=torch.float64)
    step = step_from_motion(center_motion * factors)
    return motion_from_step(image_steps(step, fitted.center_mm))


def _image_std(
    center_std: Float[Tensor, "steps motion=6"], fitted: FittedScan
) -> Float[Tensor, "steps motion=6"]:
    """Return standard deviations about the image's origin, to first order in the turns."""
    across, down = fitted.stretch
    x, y = fitted.center_mm
    lateral, axial, elevational, pitch, yaw, roll = center_std.unbind(-1)
    pitch, yaw = pitch / down, yaw / across
    return torch.stack(
        (
            torch.hypot(lateral * across, y * roll),
            torch.hypot(axial * down, x * roll),
            (elevational**2 + (y * pitch) ** 2 + (x * yaw) ** 2).sqrt(),
            pitch,
            yaw,
            roll,
        ),
        dim=-1,
    )
