"""A folder of images, one per frame, or one TIFF of many pages.

PNG, TIFF, JPEG and BMP, 8 or 16 bit, gray or colour; in natural order (``frame2`` before
``frame10``). Images tell neither times nor pixel size. Poses may lie beside them as
``poses.csv`` or ``poses.txt`` (see :mod:`sonosweep.io.pose_table`).
"""

import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.atomic import write_beside
from sonosweep.io.attach_poses import spread_poses
from sonosweep.io.hdf5_access import first_line
from sonosweep.io.pose_table import read_pose_table
from sonosweep.scan import Calibration, Frames, LazyFrames, Scan

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
FORMATS = ("PNG", "TIFF", "JPEG", "BMP")
FRAME_PATTERN = "frame[0-9][0-9][0-9][0-9]*.png"  # what we write
POSE_NAMES = ("poses.csv", "poses.txt")
LARGEST_PAGE_COUNT = 100_000
# What Pillow calls a kind of pixel, and what we make of it.
PIXEL_KINDS = {
    "1": ("L", np.uint8, 0),
    "L": ("L", np.uint8, 0),
    "LA": ("L", np.uint8, 0),
    "P": ("RGB", np.uint8, 3),
    "PA": ("RGB", np.uint8, 3),
    "RGB": ("RGB", np.uint8, 3),
    "RGBA": ("RGB", np.uint8, 3),
    "RGBX": ("RGB", np.uint8, 3),
    "CMYK": ("RGB", np.uint8, 3),
    "YCbCr": ("RGB", np.uint8, 3),
    "I;16": (None, np.uint16, 0),
    "I;16B": (None, np.uint16, 0),
    "I;16L": (None, np.uint16, 0),
    "I": (None, np.int32, 0),
    "F": (None, np.float32, 0),
}


def read_images(
    path: str | os.PathLike,
    spacing_mm: tuple[float, float] | None = None,
    poses: str | os.PathLike | None = None,
) -> Scan:
    """Return the images of a folder, or the pages of a TIFF, as a scan.

    Args:
        path: The folder or the TIFF file.
        spacing_mm: Pixel size (lateral, axial); images do not tell it.
        poses: A table of image poses, one per image or with a column ``frame``; ``None``
            takes ``poses.csv`` or ``poses.txt`` in the folder if there is one. Frames
            that the table leaves out count as not tracked.

    Raises:
        FormatError: If there are no images, one is damaged, or they differ in size or
            kind; the message names the odd one.
        ScanError: If there are more or fewer poses than images.
    """
    place = Path(path)
    with warnings.catch_warnings():
        # Pillow warns of images that unpack to hundreds of megabytes; no frame is so large.
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        warnings.simplefilter("ignore", UserWarning)  # of damaged metadata that we do not use
        pages = _list_pages(place)
        first = _look_at_all(pages)
    frames = ImageFrames(pages, *first)
    table = poses if poses is not None else _find_poses(place)
    times, image_to_reference, tracked = None, None, None
    if table is not None:
        times, image_to_reference, tracked = _poses_of_frames(Path(table), len(pages))
    return Scan(
        name=place.stem if place.is_file() else place.name,
        frames=frames,
        calibration=None if spacing_mm is None else Calibration(spacing_mm),
        timestamps_s=times,
        image_to_reference=image_to_reference,
        tracked=tracked,
    )


def write_images(frames: Frames, folder: str | os.PathLike) -> None:
    """Write frames as ``frame0000.png`` and on, without loss.

    Args:
        frames: 8-bit gray or RGB, or 16-bit gray.
        folder: It is made; it must not hold other images.

    Raises:
        FormatError: If PNG cannot hold the frames, or the folder cannot be written to or
            already holds images.
    """
    place = Path(folder)
    gray = len(frames.shape) == 3
    if not (frames.dtype == np.uint8 or (frames.dtype == np.uint16 and gray)):
        raise FormatError(
            f"PNG holds 8-bit or gray 16-bit frames, not {frames.dtype} of shape {frames.shape}:"
            " write .h5 instead"
        )
    if place.is_dir() and any(child.suffix.lower() in SUFFIXES for child in place.iterdir()):
        raise FormatError(f"folder '{place}' already holds images: give an empty one")
    digits = max(4, len(str(len(frames) - 1)))
    for i in range(len(frames)):
        with write_beside(place / f"frame{i:0{digits}d}.png") as temporary:
            Image.fromarray(np.ascontiguousarray(frames[i])).save(temporary, "PNG")


class ImageFrames(LazyFrames):
    """Images read when indexed; all have the size and kind that was found on opening.

    Args:
        pages: File and page of each frame.
        size: Columns and rows.
        kind: What Pillow calls the kind of pixel.
    """

    def __init__(self, pages: list[tuple[Path, int]], size: tuple[int, int], kind: str) -> None:
        _, dtype, channels = PIXEL_KINDS[kind]
        columns, rows = size
        super().__init__(
            (len(pages), rows, columns, *([channels] if channels else [])), np.dtype(dtype)
        )
        self._pages, self._size, self._kind = pages, size, kind

    def _read(self, frame: int) -> np.ndarray:
        file, page = self._pages[frame]
        with _open_page(file, page) as image:
            if (image.size, image.mode) != (self._size, self._kind):
                raise FormatError(f"'{file.name}' changed after it was opened: open it again")
            mode = PIXEL_KINDS[self._kind][0]
            converted = image if mode in (None, image.mode) else image.convert(mode)
            pixels = np.asarray(converted)
            return np.ascontiguousarray(pixels, dtype=self.dtype).reshape(self.shape[1:])


def natural_key(path: Path) -> tuple:
    """Return what sorts ``frame2`` before ``frame10``."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    # Text and numbers alternate, so that like is always compared with like.
    return tuple((int(part), part) if part.isdecimal() else (0, part) for part in parts), path.name


@contextmanager
def _open_page(file: Path, page: int) -> Iterator[Image.Image]:
    """Give one page of an image; everything that goes wrong becomes one sentence."""
    try:
        with Image.open(file, formats=FORMATS) as image:
            if page:
                image.seek(page)
            yield image
    except SonosweepError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise FormatError(f"'{file.name}' is too large to be a frame of ultrasound") from None
    except Exception as error:
        # Pillow's plugins let through whatever their parsers raise on damaged bytes.
        raise FormatError(
            f"'{_page_name(file, page)}' cannot be read as an image ({first_line(error)})"
        ) from error


def _look(file: Path, page: int) -> tuple[tuple[int, int], str]:
    """Return size and kind of an image without reading its pixels."""
    with _open_page(file, page) as image:
        if image.mode not in PIXEL_KINDS:
            raise FormatError(
                f"'{file.name}' has pixels of kind {image.mode}, which we do not read"
            )
        return image.size, image.mode


def _look_at_all(pages: list[tuple[Path, int]]) -> tuple[tuple[int, int], str]:
    """Return the size and kind that all images share."""
    first = _look(*pages[0])
    for file, page in pages[1:]:
        found = _look(file, page)
        if found != first:
            raise FormatError(
                f"'{_page_name(file, page)}' is {_describe(found)}, but"
                f" '{_page_name(*pages[0])}' is {_describe(first)}: all frames must be alike"
            )
    return first


def _list_pages(place: Path) -> list[tuple[Path, int]]:
    if place.is_file():
        with _open_page(place, 0) as image:
            count = int(getattr(image, "n_frames", 1))
        if count > LARGEST_PAGE_COUNT:
            raise FormatError(f"'{place.name}' claims to have {count} pages")
        return [(place, page) for page in range(count)]
    if not place.is_dir():
        raise FormatError(f"there is no folder or file '{place}'")
    files = [
        child
        for child in place.iterdir()
        if child.suffix.lower() in SUFFIXES and child.is_file() and not child.name.startswith(".")
    ]
    if not files:
        raise FormatError(f"folder '{place}' holds no {', '.join(SUFFIXES)} images")
    return [(file, 0) for file in sorted(files, key=natural_key)]


def _page_name(file: Path, page: int) -> str:
    return f"{file.name}, page {page}" if page else file.name


def _describe(found: tuple[tuple[int, int], str]) -> str:
    (columns, rows), kind = found
    return f"{columns} x {rows} pixels of kind {kind}"


def _find_poses(place: Path) -> Path | None:
    if place.is_dir():
        for name in POSE_NAMES:
            if (place / name).is_file():
                return place / name
    return None


def _poses_of_frames(
    table: Path, count: int
) -> tuple[torch.Tensor | None, torch.Tensor, torch.Tensor | None]:
    """Return times, poses and which are valid, for each image."""
    read = read_pose_table(table)
    poses, times = read.trajectory.image_to_reference, read.trajectory.timestamps_s
    frames = read.frame_indices
    if frames is None or len(frames) == count:
        if frames is not None and not torch.equal(frames, torch.arange(count)):
            raise FormatError(f"the frames in '{table.name}' are not 0 to {count - 1} in order")
        return times, poses, None
    if int(frames.max()) >= count:
        raise FormatError(
            f"{count} images but a pose of frame {int(frames.max())} in '{table.name}'"
        )
    return None, *spread_poses(poses, frames, count)
