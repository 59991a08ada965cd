"""What a simulated probe hears at each frame of a sweep, rendered when it is asked for."""

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Complex64, Float, Float32, UInt8

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid
from sonosweep.imaging.scan_convert import ScanConverter, prepare_scan_converter
from sonosweep.simulate.body import Body
from sonosweep.simulate.body_motion import BodyMotion, draw_body_motion
from sonosweep.simulate.deformation import Deformation
from sonosweep.simulate.motion import ProbeMotion, draw_motion
from sonosweep.simulate.planes import sample_plane
from sonosweep.simulate.scanner import (
    PreparedScanner,
    detect,
    fill_with_gel,
    prepare_scanner,
    receive_echoes,
)
from sonosweep.simulate.seeds import generator
from sonosweep.simulate.speckle import SpeckleRenderer
from sonosweep.simulate.sweep_settings import SweepSettings

SPARE_ECHOES = 2  # kept beyond those that persistence needs


@dataclass(frozen=True, eq=False)
class Echoes:
    """One frame before detection.

    Attributes:
        iq: Before attenuation.
        tissue: Label of each pixel.
        received: After attenuation and amplification, with clutter and noise.
    """

    iq: Complex64[np.ndarray, "rows columns"]
    tissue: UInt8[np.ndarray, "rows columns"]
    received: Complex64[np.ndarray, "rows columns"]


class SweepEchoes:
    """The echoes of a sweep; the same whatever is asked first, and the last few are kept.

    It may be copied to other processes, and several threads may ask it, one at a time.

    Args:
        settings: Of the sweep.
        body: What is scanned.
        engine: Of the speckle renderer.
        device: Of its engine ``"torch"``.

    Raises:
        ScanError: If the sweep leaves the body or is too fast.
    """

    def __init__(
        self,
        settings: SweepSettings,
        body: Body,
        engine: Literal["numba", "torch"] = "numba",
        device: str = "cpu",
    ) -> None:
        self.settings, self.body = settings, body
        self.motion: ProbeMotion = draw_motion(settings.motion, body, self.generator("motion"))
        self.body_motion: BodyMotion = draw_body_motion(
            settings.body_motion, self.generator("body motion")
        )
        self.times_s = self.motion.frame_times_s()
        self.lines: PixelGrid | SectorGrid = settings.sector or settings.grid
        self.converter: ScanConverter | None = None
        if settings.sector is not None:
            self.converter = prepare_scan_converter(settings.sector, settings.grid)
        self.prepared: PreparedScanner = prepare_scanner(
            settings.scanner, settings.beam, self.lines, self.generator("haze")
        )
        self._engine, self._device = engine, device
        self._reset()

    def _reset(self) -> None:
        self._lock = threading.RLock()
        self._renderer: SpeckleRenderer | None = None
        self._kept: OrderedDict[int, Echoes] = OrderedDict()

    def __getstate__(self) -> dict:
        """Return all but the lock and what can be rendered again."""
        left_out = ("_lock", "_renderer", "_kept")
        return {name: value for name, value in self.__dict__.items() if name not in left_out}

    def __setstate__(self, state: dict) -> None:
        """Take over what another process sent."""
        self.__dict__.update(state)
        self._reset()

    def generator(self, purpose: str) -> np.random.Generator:
        """Return the random numbers of one purpose of this sweep."""
        return generator(self.settings.subject, self.settings.scan, purpose)

    def pose_at(self, time_s: float) -> Float[np.ndarray, "4 4"]:
        """Return ``plane_to_body`` at a time."""
        return self.motion.poses_at(np.array([time_s]))[0]

    def deformation_at(self, time_s: float, plane_to_body: Float[np.ndarray, "4 4"]) -> Deformation:
        """Return how tissue is displaced at a time."""
        return self.body_motion.deformation_at(time_s, plane_to_body, self.body)

    def render(
        self, plane_to_body: Float[np.ndarray, "4 4"], deformation: Deformation
    ) -> Complex64[np.ndarray, "rows columns"]:
        """Return the echoes of a plane as if nothing attenuated."""
        with self._lock:
            if self._renderer is None:
                self._renderer = SpeckleRenderer(
                    self.body,
                    self.settings.beam,
                    self.lines,
                    seed=self.settings.subject,
                    density_per_mm3=self.settings.density_per_mm3,
                    engine=self._engine,
                    device=self._device,
                )
            return self._renderer.iq(plane_to_body, deformation)

    def at(self, frame: int) -> Echoes:
        """Return the echoes of a frame."""
        with self._lock:
            if frame not in self._kept:
                self._kept[frame] = self._hear(frame)
                if len(self._kept) > self.settings.scanner.persistence_frames + SPARE_ECHOES:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(frame)
            return self._kept[frame]

    def amplitude(self, frame: int) -> Float32[np.ndarray, "rows columns"]:
        """Return the amplitude before log compression, averaged by persistence."""
        reach = self.settings.scanner.persistence_frames // 2
        window = range(max(frame - reach, 0), min(frame + reach + 1, len(self.times_s)))
        with self._lock:
            received = [self.at(k).received for k in window]
        return detect(received, self.settings.scanner)

    def _hear(self, frame: int) -> Echoes:
        time = float(self.times_s[frame])
        pose = self.pose_at(time)
        deformation = self.deformation_at(time, pose)
        iq = self.render(pose, deformation)
        tissue = sample_plane(self.body.tissue, self.body, pose, self.lines, deformation)
        fill_with_gel(tissue)
        noise = self.generator(f"noise {frame}")
        try:
            received = receive_echoes(iq, tissue, self.prepared, noise)
        except ScanError as error:
            raise ScanError(f"frame {frame} of the sweep: {error}") from error
        return Echoes(iq, tissue, received)
