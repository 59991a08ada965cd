"""Ultrasound cine loops in DICOM: one multi-frame file, or a folder of single frames.

Pixel size and region come from the ultrasound regions, times from the frame times. Nothing
that names the patient is read, kept or written.
"""

import struct
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np
from pydicom import Dataset
from pydicom.encaps import itemize_frame
from pydicom.pixels.encoders import RLELosslessEncoder
from pydicom.pixels.utils import as_pixel_options
from pydicom.uid import RLELossless, UltrasoundMultiFrameImageStorage

from sonosweep.errors import FormatError
from sonosweep.io.atomic import write_beside
from sonosweep.io.dicom_frames import DicomFrames, is_dicom, open_dicom
from sonosweep.io.dicom_new import describe_pixels, describe_rgb, dicom_bytes, new_dicom
from sonosweep.io.dicom_regions import make_regions, read_regions
from sonosweep.io.dicom_times import (
    FrameTimes,
    read_clock_times,
    read_frame_times,
    state_frame_times,
)
from sonosweep.io.guard import refusing
from sonosweep.scan import Calibration, Frames, LazyFrames, Region, Scan

LARGEST_PIXEL_DATA_BYTES = 0xFFFFFFFE
EMPTY_OFFSET_TABLE = struct.pack("<HHI", 0xFFFE, 0xE000, 0)
END_OF_FRAGMENTS = struct.pack("<HHI", 0xFFFE, 0xE0DD, 0)


class JoinedFrames(LazyFrames):
    """Frames of which each is a file.

    Args:
        files: One frame each, all alike.
    """

    def __init__(self, files: tuple[DicomFrames, ...]) -> None:
        super().__init__((len(files), *files[0].shape[1:]), files[0].dtype)
        self._files = files

    def _read(self, frame: int) -> np.ndarray:
        return self._files[frame][0]


def read_dicom_cine(path: str | PathLike) -> Scan:
    """Return an ultrasound recording: a multi-frame file, or a folder of single frames.

    Frames are decoded when indexed; colour comes as RGB, MONOCHROME1 turned to
    MONOCHROME2. Without an ultrasound region of 2-D tissue in cm there is no calibration,
    and ``notes["calibration"]`` says so: the size of a pixel is never guessed.

    Raises:
        FormatError: If it is no DICOM recording, damaged, several recordings at once, or
            compressed in a way that no installed decoder knows.
    """
    with refusing(path, "a DICOM recording"):
        if Path(path).is_dir():
            return _read_folder(Path(path))
        header, frames = open_dicom(path)
        return _make_scan(path, header, frames, read_frame_times(header, len(frames), path))


def _read_folder(folder: Path) -> Scan:
    """Return the scan whose frames are the files of one series, by instance number."""
    names = [p for p in sorted(folder.iterdir()) if p.name != "DICOMDIR" and is_dicom(p)]
    if not names:
        raise FormatError(f"no DICOM file in folder '{folder}'")
    opened = [open_dicom(name) for name in names]
    if len(opened) == 1:
        header, frames = opened[0]
        return _make_scan(folder, header, frames, read_frame_times(header, len(frames), folder))
    opened.sort(key=lambda one: int(one[0].get("InstanceNumber") or 0))
    first = opened[0][1]
    for header, frames in opened:
        if header.get("SeriesInstanceUID") != opened[0][0].get("SeriesInstanceUID"):
            raise FormatError(
                f"'{folder}' holds several series; put the files of one into a folder of its own"
            )
        if len(frames) != 1:
            raise FormatError(
                f"'{folder}' holds several recordings; give one file, such as '{frames.path.name}'"
            )
        if frames.shape != first.shape or frames.dtype != first.dtype:
            raise FormatError(
                f"'{frames.path}' has {frames.shape[1:]} pixels of {frames.dtype}, unlike the"
                f" {first.shape[1:]} of {first.dtype} of '{first.path.name}'"
            )
    joined = JoinedFrames(tuple(frames for _, frames in opened))
    return _make_scan(
        folder, opened[0][0], joined, read_clock_times([header for header, _ in opened])
    )


def _make_scan(path: str | PathLike, header: Dataset, frames: Frames, times: FrameTimes) -> Scan:
    rows, columns = frames.shape[1:3]
    region, why = read_regions(header, rows, columns)
    notes = {
        "poses": "DICOM recordings hold no poses",
        "calibration": region.note if region else why,
        "timestamps": times[1],
    }
    return Scan(
        name=Path(path).stem,
        frames=frames,
        calibration=Calibration(spacing_mm=region.spacing_mm) if region else None,
        timestamps_s=times[0],
        region=Region(region.rectangle_px) if region else None,
        notes={what: note for what, note in notes.items() if note},
    )


def write_dicom_cine(
    scan: Scan,
    path: str | PathLike,
    blank_outside_region: bool = False,
    compressed: bool = False,
) -> None:
    """Write the frames as an Ultrasound Multi-frame Image that names nobody.

    Frames, pixel size, region and times are written (times from 0 on), under new UIDs.
    Poses and companions have no place in the format. Names burnt into the pixels stay
    unless they are blanked.

    Args:
        scan: Gray frames of 8 or 16 bits, or RGB of 8.
        path: Where to.
        blank_outside_region: Whether to write 0 outside the scan's region.
        compressed: Whether to write RLE, which is lossless and slower.

    Raises:
        FormatError: If the frames are of another type or above 4 GiB, there is no region
            to keep, or the file cannot be written.
    """
    header = _cine_header(scan, path)
    if blank_outside_region:
        header.BurnedInAnnotation = "NO"
    frames = _frames_to_write(scan, blank_outside_region)
    with write_beside(path) as temporary, temporary.open("wb") as file:
        if compressed:
            header.file_meta.TransferSyntaxUID = RLELossless
        file.write(dicom_bytes(header))
        if compressed:
            _write_fragments(file, header, frames)
        else:
            _write_plain(file, header, frames, path)


def _cine_header(scan: Scan, path: str | PathLike) -> Dataset:
    count, rows, columns = scan.frames.shape[:3]
    channels, dtype = scan.frames.shape[3:], np.dtype(scan.frames.dtype)
    header = new_dicom(UltrasoundMultiFrameImageStorage, "US")
    if channels == (3,) and dtype == np.uint8:
        describe_rgb(header, rows, columns)
    elif channels == () and dtype.name in ("uint8", "uint16", "int16"):
        describe_pixels(header, rows, columns, dtype.itemsize * 8, signed=dtype.kind == "i")
    else:
        raise FormatError(
            f"cannot write frames of {channels or 'one channel'} and type {dtype} to '{path}';"
            " DICOM takes gray of 8 or 16 bits and RGB of 8"
        )
    header.ImageType = ["DERIVED", "SECONDARY"]
    header.NumberOfFrames = count
    header.UltrasoundColorDataPresent = int(channels == (3,))
    state_frame_times(header, scan.timestamps_s)
    if regions := make_regions(scan):
        header.SequenceOfUltrasoundRegions = regions
    return header


def _frames_to_write(scan: Scan, blank_outside_region: bool) -> Iterator[np.ndarray]:
    """Give each frame, contiguous and little-endian."""
    keep = None
    if blank_outside_region:
        keep = _kept_pixels(scan)
    little = np.dtype(scan.frames.dtype).newbyteorder("little")
    for index in range(len(scan.frames)):
        frame = np.array(scan.frames[index], dtype=little, order="C")
        if keep is not None:
            frame[~keep] = 0
        yield frame


def _kept_pixels(scan: Scan) -> np.ndarray:
    if scan.region is None:
        raise FormatError(
            f"no region is known in '{scan.name}', so nothing can be blanked: give a region first"
        )
    column, row, width, height = scan.region.rectangle_px
    keep = np.zeros(scan.frames.shape[1:3], dtype=bool)
    keep[row : row + height, column : column + width] = True
    return keep if scan.region.mask is None else keep & scan.region.mask


def _write_plain(
    file: BinaryIO, header: Dataset, frames: Iterator[np.ndarray], path: str | PathLike
) -> None:
    bits = header.BitsAllocated * header.SamplesPerPixel
    length = header.NumberOfFrames * header.Rows * header.Columns * bits // 8
    if length > LARGEST_PIXEL_DATA_BYTES:
        raise FormatError(
            f"{length / 2**30:.1f} GiB of pixels do not fit in '{path}', which ends at 4 GiB: write"
            " it compressed, or fewer frames"
        )
    kind = b"OB" if header.BitsAllocated == 8 else b"OW"
    file.write(struct.pack("<HH2sHI", 0x7FE0, 0x0010, kind, 0, length + length % 2))
    for frame in frames:
        file.write(frame.data)
    file.write(b"\0" * (length % 2))


def _write_fragments(file: BinaryIO, header: Dataset, frames: Iterator[np.ndarray]) -> None:
    options = as_pixel_options(header, number_of_frames=1)
    file.write(struct.pack("<HH2sHI", 0x7FE0, 0x0010, b"OB", 0, 0xFFFFFFFF))
    file.write(EMPTY_OFFSET_TABLE)
    for frame in frames:
        packed = RLELosslessEncoder.encode(frame, encoding_plugin="pydicom", **options)
        for item in itemize_frame(packed):
            file.write(item)
    file.write(END_OF_FRAGMENTS)
