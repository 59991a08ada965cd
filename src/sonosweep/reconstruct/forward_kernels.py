"""Loops of forward compounding: over pixels, into the voxels of one slab.

A slab is a box of voxels that one thread owns; it sees every frame in order and writes to
no other, so the result does not depend on the number of threads. Pixels of a row lie on a
line: which of them fall into the slab is a division, not a test per pixel. Coordinates are
the same floats whatever the slab, so that no pixel is lost or counted twice between two.

Arguments that the kernels share:
    frames: ``(frames, rows, columns)``, in the general kernels with channels last.
    pixel_to_voxel: Per frame, (column, row, 1) to voxel (x, y, z).
    first_run, runs: Kept pixels, from :func:`sonosweep.reconstruct.clip.pixel_runs`.
    low, high: First and one-past-last voxel (x, y, z) of the slab.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

# 12 bits of count over 20 bits of sum: 4095 pixels of 255 just fit.
NEAREST_FULL = np.uint32(0xFFF00000)
# 28 bits of weight (4096 per pixel) over 36 bits of weighted sum: 65535 pixels of 255 fit.
# The top bit says that it is time to empty the word.
WEIGHT_SHIFT = np.uint64(36)
SUM_BITS = np.uint64((1 << 36) - 1)
FRACTIONS = 16.0
"""Linear interpolation places a pixel to a sixteenth of a voxel."""
FULL_WEIGHT = 4096
"""Weight of a pixel that lies on a voxel: the three fractions multiplied."""
AN_EIGHTH = FULL_WEIGHT // 8
"""A pixel amid eight voxels counts for all of them, otherwise for the nearer ones (PLUS)."""


@njit(cache=True, nogil=True)
@no_type_check
def _span(start, step, low, high, first, last):
    """Columns of [first, last) for which low <= start + column * step < high."""
    if step == 0.0:
        return (first, last) if low <= start < high else (first, first)
    a, b = (low - start) / step, (high - start) / step
    if step < 0.0:
        a, b = b, a
    begin = int(min(max(math.floor(a) - 1.0, float(first)), float(last)))
    end = int(min(max(math.ceil(b) + 2.0, float(first)), float(last)))
    # The division rounds; what counts is the comparison that the other slabs make too.
    while begin < end and not low <= start + begin * step < high:
        begin += 1
    while begin < end and not low <= start + (end - 1) * step < high:
        end -= 1
    return begin, end


@njit(cache=True, nogil=True)
@no_type_check
def _point(matrix, column, row, scale, shift, axis):
    """One scaled coordinate of a pixel; every loop below evaluates this same expression."""
    start = (matrix[axis, 2] + row * matrix[axis, 1]) * scale + shift
    return start + column * (matrix[axis, 0] * scale)


@njit(cache=True, nogil=True)
@no_type_check
def _frame_is_inside(matrix, rows, columns, scale, shift, low, high):
    """Whether all pixels are in the box: coordinates grow along rows and columns."""
    for axis in range(3):
        for row in (0, rows - 1):
            for column in (0, columns - 1):
                value = _point(matrix, column, row, scale, shift, axis)
                if not low[axis] <= value < high[axis]:
                    return False
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _clip_row(matrix, row, scale, shift, low, high, first, last):
    """Columns of a row that are in a box of scaled coordinates."""
    for axis in range(3):
        start = _point(matrix, 0, row, scale, shift, axis)
        first, last = _span(start, matrix[axis, 0] * scale, low[axis], high[axis], first, last)
        if first >= last:
            break
    return first, last


@njit(cache=True, nogil=True)
@no_type_check
def _nearest_indices(matrix, row, low, size, first, last, indices):
    """Slab index of the voxel nearest to each pixel of a row.

    Slabs have fewer than 2**31 voxels, and 32-bit integers wrap around to the right index
    even where the offset of the slab is larger.
    """
    stride_y, stride_z = np.int32(size[0]), np.int32(size[0] * size[1])
    offset = np.int32(low[0] + size[0] * (low[1] + size[1] * low[2]))
    x_start, x_step = _point(matrix, 0, row, 1.0, 0.5, 0), matrix[0, 0]
    y_start, y_step = _point(matrix, 0, row, 1.0, 0.5, 1), matrix[1, 0]
    z_start, z_step = _point(matrix, 0, row, 1.0, 0.5, 2), matrix[2, 0]
    for k in range(last - first):
        column = float(np.int32(first + k))
        x = np.int32(x_start + column * x_step)
        y = np.int32(y_start + column * y_step)
        z = np.int32(z_start + column * z_step)
        plane = np.int32(np.int32(y * stride_y) + np.int32(z * stride_z))
        indices[k] = np.uint32(np.int32(x - offset) + plane)


@njit(cache=True, nogil=True)
@no_type_check
def nearest_mean(frames, pixel_to_voxel, first_run, runs, increment, low, high, packed, spilled):
    """Add 8-bit pixels to the nearest voxel, count and sum in one word.

    ``increment`` gives the word to add for each gray level: 0 for a rejected one. A voxel
    that is full is emptied into ``spilled``, so that sums stay exact; returns how many were.
    """
    size = high - low
    low_edge, high_edge = low.astype(np.float64), high.astype(np.float64)
    indices = np.empty(frames.shape[2], np.uint32)
    spills = 0
    for f in range(frames.shape[0]):
        matrix = pixel_to_voxel[f]
        inside = _frame_is_inside(
            matrix, frames.shape[1], frames.shape[2], 1.0, 0.5, low_edge, high_edge
        )
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = runs[run, 0], runs[run, 1]
                if not inside:
                    first, last = _clip_row(matrix, row, 1.0, 0.5, low_edge, high_edge, first, last)
                _nearest_indices(matrix, row, low, size, first, last, indices)
                pixels = frames[f, row, first:last]
                for k in range(last - first):
                    index = indices[k]
                    word = packed[index] + increment[pixels[k]]
                    if word >= NEAREST_FULL:
                        spilled[index, 0] += word >> 20
                        spilled[index, 1] += word & 0xFFFFF
                        word = np.uint32(0)
                        spills += 1
                    packed[index] = word
    return spills


@njit(cache=True, nogil=True)
@no_type_check
def nearest_sum(frames, pixel_to_voxel, first_run, runs, reject, low, high, count, total):
    """Add pixels of any type and number of channels to the nearest voxel."""
    size = high - low
    low_edge, high_edge = low.astype(np.float64), high.astype(np.float64)
    indices = np.empty(frames.shape[2], np.uint32)
    for f in range(frames.shape[0]):
        matrix = pixel_to_voxel[f]
        inside = _frame_is_inside(
            matrix, frames.shape[1], frames.shape[2], 1.0, 0.5, low_edge, high_edge
        )
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = runs[run, 0], runs[run, 1]
                if not inside:
                    first, last = _clip_row(matrix, row, 1.0, 0.5, low_edge, high_edge, first, last)
                _nearest_indices(matrix, row, low, size, first, last, indices)
                for k in range(last - first):
                    pixel = frames[f, row, first + k]
                    if is_kept(pixel, reject):
                        count[indices[k]] += 1
                        for channel in range(pixel.size):
                            total[indices[k], channel] += pixel[channel]


@njit(cache=True, nogil=True)
@no_type_check
def is_kept(pixel, reject):
    """Whether some channel reaches the threshold and all are finite."""
    kept = False
    for channel in range(pixel.size):
        if not math.isfinite(pixel[channel]):
            return False
        kept |= pixel[channel] >= reject
    return kept


@njit(cache=True, nogil=True)
@no_type_check
def nearest_replace(
    frames, pixel_to_voxel, first_run, runs, reject, low, high, maximum, count, value
):
    """Keep the largest pixel (``maximum``) or the latest one in the nearest voxel."""
    size = high - low
    low_edge, high_edge = low.astype(np.float64), high.astype(np.float64)
    indices = np.empty(frames.shape[2], np.uint32)
    for f in range(frames.shape[0]):
        matrix = pixel_to_voxel[f]
        inside = _frame_is_inside(
            matrix, frames.shape[1], frames.shape[2], 1.0, 0.5, low_edge, high_edge
        )
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = runs[run, 0], runs[run, 1]
                if not inside:
                    first, last = _clip_row(matrix, row, 1.0, 0.5, low_edge, high_edge, first, last)
                _nearest_indices(matrix, row, low, size, first, last, indices)
                for k in range(last - first):
                    pixel = frames[f, row, first + k]
                    if is_kept(pixel, reject):
                        _replace(pixel, indices[k], maximum, count, value)


@njit(cache=True, nogil=True)
@no_type_check
def _replace(pixel, index, maximum, count, value):
    for channel in range(pixel.size):
        if not maximum or count[index] == 0 or pixel[channel] > value[index, channel]:
            value[index, channel] = pixel[channel]
    count[index] = min(count[index] + 1, 255)


@njit(cache=True, nogil=True)
@no_type_check
def _linear_cells(matrix, row, low, size, first, last, indices, fractions):
    """Slab index of the lowest of the eight voxels around each pixel, and where between.

    The slab has a margin of one voxel all around, so that pixels near its faces need no
    special case; index 0 is voxel ``low - 1``.
    """
    stride_y, stride_z = np.int32(size[0]), np.int32(size[0] * size[1])
    offset = np.int32(low[0] + size[0] * (low[1] + size[1] * low[2]))
    x_start, x_step = _point(matrix, 0, row, FRACTIONS, 16.5, 0), matrix[0, 0] * FRACTIONS
    y_start, y_step = _point(matrix, 0, row, FRACTIONS, 16.5, 1), matrix[1, 0] * FRACTIONS
    z_start, z_step = _point(matrix, 0, row, FRACTIONS, 16.5, 2), matrix[2, 0] * FRACTIONS
    for k in range(last - first):
        column = float(np.int32(first + k))
        x = np.int32(x_start + column * x_step)
        y = np.int32(y_start + column * y_step)
        z = np.int32(z_start + column * z_step)
        plane = np.int32(np.int32((y >> 4) * stride_y) + np.int32((z >> 4) * stride_z))
        indices[k] = np.uint32(np.int32((x >> 4) - offset) + plane)
        fractions[k] = np.int32((x & 15) | ((y & 15) << 4) | ((z & 15) << 8))


@njit(cache=True, nogil=True)
@no_type_check
def linear_mean(frames, pixel_to_voxel, first_run, runs, increment, low, high, packed, spilled):
    """Share 8-bit pixels among the eight voxels around them, weight and sum in one word.

    ``increment`` gives the word to add per unit of weight for each gray level: 0 for a
    rejected one. Words that fill up are emptied into ``spilled``, so that sums stay exact;
    returns how often.
    """
    size = high - low + 2
    stride_y, stride_z = np.uint32(size[0]), np.uint32(size[0] * size[1])
    low_edge, high_edge = low * FRACTIONS, (high + 1) * FRACTIONS
    indices = np.empty(frames.shape[2], np.uint32)
    fractions = np.empty(frames.shape[2], np.int32)
    spills = 0
    for f in range(frames.shape[0]):
        matrix = pixel_to_voxel[f]
        inside = _frame_is_inside(
            matrix, frames.shape[1], frames.shape[2], FRACTIONS, 16.5, low_edge, high_edge
        )
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = runs[run, 0], runs[run, 1]
                if not inside:
                    first, last = _clip_row(
                        matrix, row, FRACTIONS, 16.5, low_edge, high_edge, first, last
                    )
                _linear_cells(matrix, row, low, size, first, last, indices, fractions)
                pixels = frames[f, row, first:last]
                for k in range(last - first):
                    word = increment[pixels[k]]
                    along_x = np.uint64(fractions[k] & 15)
                    along_y = np.uint64((fractions[k] >> 4) & 15)
                    along_z = np.uint64(fractions[k] >> 8)
                    corner = indices[k]
                    full = _add_pair(
                        packed, corner, word * (16 - along_y) * (16 - along_z), along_x
                    )
                    corner += stride_y
                    full |= _add_pair(packed, corner, word * along_y * (16 - along_z), along_x)
                    corner += stride_z
                    full |= _add_pair(packed, corner, word * along_y * along_z, along_x)
                    corner -= stride_y
                    full |= _add_pair(packed, corner, word * (16 - along_y) * along_z, along_x)
                    if full >> np.uint64(63):
                        _spill_cell(packed, spilled, indices[k], stride_y, stride_z)
                        spills += 1
    return spills


@njit(cache=True, nogil=True)
@no_type_check
def _add_pair(packed, index, word, along_x):
    """Share a word between a voxel and the next along x; returns bits set in either."""
    beyond = word * along_x
    first = packed[index] + (word << np.uint64(4)) - beyond
    second = packed[index + np.uint32(1)] + beyond
    packed[index] = first
    packed[index + np.uint32(1)] = second
    return first | second


@njit(cache=True, nogil=True)
@no_type_check
def _spill_cell(packed, spilled, index, stride_y, stride_z):
    for corner in range(8):
        at = index + (corner & 1) + ((corner >> 1) & 1) * stride_y + (corner >> 2) * stride_z
        spilled[at, 0] += packed[at] >> WEIGHT_SHIFT
        spilled[at, 1] += packed[at] & SUM_BITS
        packed[at] = 0


@njit(cache=True, nogil=True)
@no_type_check
def _corner_weight(fraction, corner):
    x, y, z = fraction & 15, (fraction >> 4) & 15, fraction >> 8
    weight = x if corner & 1 else 16 - x
    weight *= y if corner & 2 else 16 - y
    return weight * (z if corner & 4 else 16 - z)


@njit(cache=True, nogil=True)
@no_type_check
def linear_sum(frames, pixel_to_voxel, first_run, runs, reject, low, high, weight, total):
    """Share pixels of any type and number of channels among the eight voxels around them."""
    size = high - low + 2
    low_edge, high_edge = low * FRACTIONS, (high + 1) * FRACTIONS
    indices = np.empty(frames.shape[2], np.uint32)
    fractions = np.empty(frames.shape[2], np.int32)
    for f in range(frames.shape[0]):
        matrix = pixel_to_voxel[f]
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = _clip_row(
                    matrix, row, FRACTIONS, 16.5, low_edge, high_edge, runs[run, 0], runs[run, 1]
                )
                _linear_cells(matrix, row, low, size, first, last, indices, fractions)
                for k in range(last - first):
                    pixel = frames[f, row, first + k]
                    if not is_kept(pixel, reject):
                        continue
                    for corner in range(8):
                        share = _corner_weight(fractions[k], corner)
                        at = indices[k] + _corner_offset(corner, size)
                        weight[at] += share
                        for channel in range(pixel.size):
                            total[at, channel] += share * np.float64(pixel[channel])


@njit(cache=True, nogil=True)
@no_type_check
def _corner_offset(corner, size):
    return (corner & 1) + ((corner >> 1) & 1) * size[0] + (corner >> 2) * size[0] * size[1]


@njit(cache=True, nogil=True)
@no_type_check
def linear_replace(
    frames, pixel_to_voxel, first_run, runs, reject, low, high, maximum, count, value
):
    """Keep the largest or the latest of the pixels within reach of a voxel.

    A pixel reaches those of the eight voxels around it for which its linear weight is an
    eighth or more; this is PLUS's rule.
    """
    size = high - low + 2
    low_edge, high_edge = low * FRACTIONS, (high + 1) * FRACTIONS
    indices = np.empty(frames.shape[2], np.uint32)
    fractions = np.empty(frames.shape[2], np.int32)
    for f in range(frames.shape[0]):
        matrix = pixel_to_voxel[f]
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = _clip_row(
                    matrix, row, FRACTIONS, 16.5, low_edge, high_edge, runs[run, 0], runs[run, 1]
                )
                _linear_cells(matrix, row, low, size, first, last, indices, fractions)
                for k in range(last - first):
                    pixel = frames[f, row, first + k]
                    if not is_kept(pixel, reject):
                        continue
                    for corner in range(8):
                        if _corner_weight(fractions[k], corner) >= AN_EIGHTH:
                            at = indices[k] + _corner_offset(corner, size)
                            _replace(pixel, at, maximum, count, value)


@njit(cache=True, nogil=True)
@no_type_check
def finish_packed(
    packed, spilled, has_spilled, shift, mask, per_unit, margin, low, voxels, coverage
):
    """Write the rounded means of a slab of packed words; axes are (z, y, x)."""
    for z in range(packed.shape[0] - 2 * margin):
        for y in range(packed.shape[1] - 2 * margin):
            words = packed[z + margin, y + margin, margin : packed.shape[2] - margin]
            if not (has_spilled or _any(words)):
                continue  # leave the empty part of the volume untouched, it costs no memory
            row = voxels[low[2] + z, low[1] + y, low[0] : low[0] + words.size]
            seen = coverage[low[2] + z, low[1] + y, low[0] : low[0] + words.size]
            for x in range(words.size):
                weight = np.float64(words[x] >> shift)
                total = np.float64(words[x] & mask)
                if has_spilled:
                    weight += spilled[z + margin, y + margin, margin + x, 0]
                    total += spilled[z + margin, y + margin, margin + x, 1]
                # Where there is no weight there is no sum: 0.5 is cut off to 0.
                row[x] = np.uint8(np.int32(total / max(weight, 1.0) + 0.5))
                seen[x] = np.uint8(np.int32(min(np.ceil(weight * per_unit), 255.0)))


@njit(cache=True, nogil=True)
@no_type_check
def _any(words):
    bits = words[0]
    for x in range(words.size):
        bits |= words[x]
    return bits != 0


@njit(cache=True, nogil=True)
@no_type_check
def finish_sums(weight, total, rounding, unit, margin, low, voxels, coverage):
    """Write the means of a slab; ``rounding`` is 0.5 for integer voxels and 0 for floats."""
    for z in range(weight.shape[0] - 2 * margin):
        for y in range(weight.shape[1] - 2 * margin):
            for x in range(weight.shape[2] - 2 * margin):
                seen = weight[z + margin, y + margin, x + margin]
                if seen == 0:
                    continue
                at = (low[2] + z, low[1] + y, low[0] + x)
                coverage[at] = np.uint8(min(math.ceil(seen / unit), 255.0))
                for channel in range(voxels.shape[3]):
                    mean = total[z + margin, y + margin, x + margin, channel] / seen
                    if rounding > 0:
                        mean = math.floor(mean + rounding)
                    voxels[at[0], at[1], at[2], channel] = mean


@njit(cache=True, nogil=True)
@no_type_check
def nearest_count(frames, pixel_to_voxel, first_run, runs, reject, low, high, count):
    """Count the pixels that are nearest to each voxel."""
    size = high - low
    low_edge, high_edge = low.astype(np.float64), high.astype(np.float64)
    indices = np.empty(frames.shape[2], np.uint32)
    for f in range(frames.shape[0]):
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = _clip_row(
                    pixel_to_voxel[f],
                    row,
                    1.0,
                    0.5,
                    low_edge,
                    high_edge,
                    runs[run, 0],
                    runs[run, 1],
                )
                _nearest_indices(pixel_to_voxel[f], row, low, size, first, last, indices)
                for k in range(last - first):
                    if is_kept(frames[f, row, first + k], reject):
                        count[indices[k]] += 1


@njit(cache=True, nogil=True)
@no_type_check
def nearest_collect(frames, pixel_to_voxel, first_run, runs, reject, low, high, next_, samples):
    """Put the pixels that are nearest to each voxel side by side; ``next_`` is where."""
    size = high - low
    low_edge, high_edge = low.astype(np.float64), high.astype(np.float64)
    indices = np.empty(frames.shape[2], np.uint32)
    for f in range(frames.shape[0]):
        for row in range(frames.shape[1]):
            for run in range(first_run[row], first_run[row + 1]):
                first, last = _clip_row(
                    pixel_to_voxel[f],
                    row,
                    1.0,
                    0.5,
                    low_edge,
                    high_edge,
                    runs[run, 0],
                    runs[run, 1],
                )
                _nearest_indices(pixel_to_voxel[f], row, low, size, first, last, indices)
                for k in range(last - first):
                    pixel = frames[f, row, first + k]
                    if is_kept(pixel, reject):
                        for channel in range(pixel.size):
                            samples[channel, next_[indices[k]]] = pixel[channel]
                        next_[indices[k]] += 1


@njit(cache=True, nogil=True)
@no_type_check
def finish_medians(stop, samples, rounding, low, high, voxels, coverage):
    """Write the median of each voxel's samples, which end at ``stop``."""
    start, at = np.int64(0), 0
    for z in range(low[2], high[2]):
        for y in range(low[1], high[1]):
            for x in range(low[0], high[0]):
                n = stop[at] - start
                if n > 0:
                    coverage[z, y, x] = min(n, 255)
                    for channel in range(samples.shape[0]):
                        ordered = np.sort(samples[channel, start : start + n])
                        middle = (np.float64(ordered[(n - 1) // 2]) + ordered[n // 2]) / 2
                        if rounding > 0:
                            middle = math.floor(middle + rounding)
                        voxels[z, y, x, channel] = middle
                start, at = stop[at], at + 1
