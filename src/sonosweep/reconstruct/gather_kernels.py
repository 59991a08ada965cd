"""Loops of gather compounding: over voxels near a frame, each sampling the frame.

Voxels are kept in bricks of 8 x 8 x 8. A brick's slowest axis is the volume axis nearest to
the mean normal of the frames, so that one layer of 64 voxels is either near a frame or not.
Coordinates within a frame are integers of 16 fractional bits: a layer is one addition per
voxel from a table, sums do not depend on the order of axes, and results are the same on
every processor. Each thread owns the bricks of its turn and sees all frames in order.

A *cell* is the square between four neighboring pixels. The frame is packed into one 32-bit
word per cell, so that a sample is one load. Frames have a rim of cells half outside, in
which the outermost pixels are repeated: a pixel covers its own area.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

BRICK = 8
LAYER = 64
VOXELS = 512
ONE = 1 << 16
"""A pixel, and the radius of a frame, in fixed point."""
ROUND = 1 << 11
"""Fractions are rounded to a sixteenth of a pixel."""
FIRST = ONE // 2 + ROUND
"""Fixed-point coordinate of the outer edge of the first pixel, with the rim of one."""
FULL_WEIGHT = 63
MOST_FRAMES = (2**31 - 1) // (255 * 16 * FULL_WEIGHT)
"""Frames of full weight until the sum of a voxel could overflow."""
MASKED = np.uint32(0xFF0000FF)
"""Marks a cell that does not count: a checkerboard of black and white, which no image has."""

# One array holds a layer's table and scratch: the compiler then sees that they are apart.
_U, _V, _D, _CELL, _FRACTION, _WEIGHT = 0, 64, 128, 192, 256, 320
LANES = 384


@njit(cache=True, nogil=True)
@no_type_check
def average_boxes(frame, box, averaged):
    """Fill the rounded means of boxes of ``box`` (rows, columns); edge ones may be smaller."""
    rows, columns = frame.shape
    if box[0] == 2 and box[1] == 2:
        for j in range(rows // 2):
            upper, lower, out = frame[2 * j], frame[2 * j + 1], averaged[j]
            for i in range(columns // 2):
                total = np.uint16(2) + upper[2 * i] + upper[2 * i + 1]
                out[i] = np.uint8((total + lower[2 * i] + lower[2 * i + 1]) >> 2)
        first_row, first_column = rows // 2, columns // 2
    else:
        first_row, first_column = 0, 0
    for j in range(averaged.shape[0]):
        for i in range(0 if j >= first_row else first_column, averaged.shape[1]):
            total, count = 0, 0
            for row in range(j * box[0], min((j + 1) * box[0], rows)):
                for column in range(i * box[1], min((i + 1) * box[1], columns)):
                    total += frame[row, column]
                    count += 1
            averaged[j, i] = (total + count // 2) // count


@njit(cache=True, nogil=True)
@no_type_check
def pack_cells(image, kept, words):
    """Pack the four pixels around each cell; ``kept`` is empty or says which cells count."""
    rows, columns = image.shape
    width = columns + 1
    for j in range(rows + 1):
        upper = image[max(j - 1, 0)]
        lower = image[min(j, rows - 1)]
        row = words[j * width : (j + 1) * width]
        row[0] = (np.uint32(upper[0]) * 0x101) | (np.uint32(lower[0]) * 0x1010000)
        for i in range(columns - 1):
            left = np.uint32(np.uint32(upper[i]) | np.uint32(np.uint32(lower[i]) << 16))
            right = np.uint32(np.uint32(upper[i + 1]) | np.uint32(np.uint32(lower[i + 1]) << 16))
            row[i + 1] = np.uint32(left | np.uint32(right << 8))
        last = columns - 1
        row[columns] = (np.uint32(upper[last]) * 0x101) | (np.uint32(lower[last]) * 0x1010000)
    if kept.size > 0:
        for cell in range(kept.size):
            # A checkerboard that is really there loses one of 255 gray levels.
            word = words[cell] if words[cell] != MASKED else np.uint32(0xFE0000FF)
            words[cell] = word if kept[cell] else MASKED
    words[width * (rows + 1)] = MASKED


@njit(cache=True, nogil=True)
@no_type_check
def list_bricks(planes, reach, boxes, half_size, order, first, bricks):
    """List the bricks that each frame meets; returns how many there are in all.

    Args:
        planes: Per frame, voxel (x, y, z, 1) to (column, row) of the image and height.
        reach: Per frame, the largest height that counts.
        boxes: Per frame, first and one-past-last brick along x, y and z to look at.
        half_size: Of the image: the brick must meet [-1/2, size - 1/2] in both directions.
        order: Axes of the volume from the slowest in a brick to the fastest.
        first: Filled with the index of each frame's first brick, and the total.
        bricks: Filled with bricks (x, y, z) as far as it has room.
    """
    count = 0
    slow, mid, fast = order[0], order[1], order[2]
    half, step, center = np.empty(3), np.empty((3, 3)), np.empty(3)
    for f in range(planes.shape[0]):
        first[f] = count
        for k in range(3):
            half[k] = 1e-6  # rounding: a brick too many does no harm
            center[k] = planes[f, k, 3]
            for axis in range(3):
                half[k] += abs(planes[f, k, axis]) * (BRICK - 1) / 2
                center[k] += planes[f, k, axis] * (BRICK - 1) / 2
                step[k, axis] = planes[f, k, axis] * BRICK
        thick, rise = reach[f] + half[2], step[2, slow]
        # A frame along the slow axis: all bricks of a column are at the same height.
        level = abs(rise) < 1e-9 * thick
        bricks_per_mm = 0.0 if level else 1.0 / rise
        wide, tall = half_size[0] + half[0], half_size[1] + half[1]
        for b in range(boxes[f, mid, 0], boxes[f, mid, 1]):
            for a in range(boxes[f, fast, 0], boxes[f, fast, 1]):
                height = center[2] + b * step[2, mid] + a * step[2, fast]
                begin, end = _slow_range(
                    height, thick, bricks_per_mm, boxes[f, slow, 0], boxes[f, slow, 1]
                )
                u = center[0] + b * step[0, mid] + a * step[0, fast] + 0.5 - half_size[0]
                v = center[1] + b * step[1, mid] + a * step[1, fast] + 0.5 - half_size[1]
                for c in range(begin, end):
                    if abs(u + c * step[0, slow]) <= wide and abs(v + c * step[1, slow]) <= tall:
                        if count < bricks.shape[0]:
                            bricks[count, slow], bricks[count, mid] = c, b
                            bricks[count, fast] = a
                        count += 1
    first[planes.shape[0]] = count
    return count


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _slow_range(height, thick, bricks_per_mm, begin, end):
    """Bricks of a column that are no higher than ``thick``; 0 bricks per mm means all alike."""
    if bricks_per_mm == 0.0:
        return (begin, end if abs(height) <= thick else begin)
    middle, extent = -height * bricks_per_mm, thick * abs(bricks_per_mm)
    low, high = max(middle - extent, float(begin)), min(middle + extent, float(end) - 1.0)
    return (np.int64(math.ceil(low)), np.int64(math.floor(high)) + 1)


@njit(cache=True, nogil=True)
@no_type_check
def _fill_steps(matrix, mid, fast, steps, lanes):
    """Tabulate how far each voxel of a layer is from the first.

    Returns:
        Height of the middle of a layer above its first voxel, and how much its voxels
        differ from it at most.
    """
    for row in range(3):
        for axis in range(3):
            steps[row, axis] = np.int32(math.floor(matrix[row, axis] + 0.5))
    for j in range(BRICK):
        for i in range(BRICK):
            lane = j * BRICK + i
            lanes[_U + lane] = j * steps[0, mid] + i * steps[0, fast]
            lanes[_V + lane] = j * steps[1, mid] + i * steps[1, fast]
            lanes[_D + lane] = j * steps[2, mid] + i * steps[2, fast]
    along_mid, along_fast = np.int64(steps[2, mid]) * 7, np.int64(steps[2, fast]) * 7
    return (along_mid + along_fast) // 2, (abs(along_mid) + abs(along_fast)) // 2 + 2


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _locate(u_first, v_first, d_first, peak, size, width, outside, lanes):
    """Find the cell, the place in it and the weight of each voxel of a layer."""
    for lane in range(LAYER):
        u = np.int32(u_first + lanes[_U + lane])
        v = np.int32(v_first + lanes[_V + lane])
        d = np.int32(d_first + lanes[_D + lane])
        inside = (np.uint32(u - FIRST) < size[0]) & (np.uint32(v - FIRST) < size[1])
        cell = np.int32(np.int32(np.int32(v >> 16) * width) + np.int32(u >> 16))
        lanes[_CELL + lane] = cell if inside else outside
        lanes[_FRACTION + lane] = np.int32(((u >> 12) & 15) | ((v >> 8) & 240))
        weight = np.int32(np.int32(peak - abs(d)) >> 10)
        lanes[_WEIGHT + lane] = max(weight, np.int32(0))


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _add_layer(words, sign, reject, lanes, totals, weights):
    """Sample the cells and add to the sums of a layer; ``sign`` -1 takes out again."""
    for lane in range(LAYER):
        lanes[_CELL + lane] = np.int32(words[np.uint32(lanes[_CELL + lane])])
    for lane in range(LAYER):
        word = np.uint32(lanes[_CELL + lane])
        across = np.uint32(lanes[_FRACTION + lane] & 15)
        down = np.uint32(np.uint32(lanes[_FRACTION + lane]) >> 4)
        left = np.uint32(word & 0x00FF00FF)
        right = np.uint32(np.uint32(word >> 8) & 0x00FF00FF)
        both = np.uint32(np.uint32(left * np.uint32(16 - across)) + np.uint32(right * across))
        upper, lower = np.uint32(both & 0xFFFF), np.uint32(both >> 16)
        value = np.uint32(np.uint32(upper * np.uint32(16 - down)) + np.uint32(lower * down))
        value = np.int32(np.uint32(value + 8) >> 4)
        counts = (word != MASKED) & (value >= reject)
        weight = np.int32(lanes[_WEIGHT + lane] * sign) if counts else np.int32(0)
        totals[lane] += np.int32(value * weight)
        weights[lane] += weight


@njit(cache=True, nogil=True)
@no_type_check
def gather_bytes(
    frames,
    box,
    kept,
    fixed,
    peaks,
    first,
    numbers,
    bricks,
    slot_of,
    order,
    turn,
    sign,
    reject,
    used,
    pool,
):
    """Add 8-bit frames to the bricks of one thread, or take them out.

    Args:
        frames: ``(frames, rows, columns)``.
        box: Rows and columns that are averaged first.
        kept: Empty, or which cells of the averaged frame count.
        fixed: Per frame, voxel (x, y, z, 1) to fixed-point (column, row, height); heights
            are in units of the radius, times the confidence.
        peaks: Per frame, weight in its plane, in fixed point.
        first: Index of each frame's first brick in ``numbers``, and the total.
        numbers: Bricks that the frames meet, by number.
        bricks: Bricks (x, y, z) by number.
        slot_of: Where each of them is in the pool, by number.
        order: Axes of the volume from the slowest in a brick to the fastest.
        turn: (this thread, number of threads).
        sign: 1 adds, -1 takes out.
        reject: Sixteen times the darkest gray level that counts.
        used: Per slot, how many frames it has seen.
        pool: ``(slots, 2, 512)``: sums, sixteen times the gray level times the weight; and
            weights.

    Returns:
        How many bricks were about to overflow and were halved.
    """
    rows, columns = -(-frames.shape[1] // box[0]), -(-frames.shape[2] // box[1])
    width, outside = np.int32(columns + 1), np.int32((rows + 1) * (columns + 1))
    size = _fixed_size(frames, box)
    averaged = np.empty((rows, columns), np.uint8)
    words = np.empty(outside + 1, np.uint32)
    lanes, steps = np.empty(LANES, np.int32), np.empty((3, 3), np.int32)
    slow, mid = order[0], order[1]
    halved = 0
    for f in range(frames.shape[0]):
        if first[f] == first[f + 1] or peaks[f] < 0:
            continue
        image = frames[f]
        if box[0] > 1 or box[1] > 1:
            average_boxes(frames[f], box, averaged)
            image = averaged
        pack_cells(image, kept, words)
        peak = np.int32(peaks[f])
        middle, span = _fill_steps(fixed[f], mid, order[2], steps, lanes)
        for p in range(first[f], first[f + 1]):
            brick = bricks[numbers[p]]
            if (brick[slow] + brick[mid]) % turn[1] != turn[0]:
                continue
            slot = slot_of[numbers[p]]
            u, v, d = _corner(fixed[f], brick)
            for layer in range(BRICK):
                height = d + layer * steps[2, slow]
                if abs(height + middle) > span + peak:
                    continue
                across = np.int32(u + layer * steps[0, slow])
                down = np.int32(v + layer * steps[1, slow])
                _locate(across, down, np.int32(height), peak, size, width, outside, lanes)
                at = layer * LAYER
                totals, weights = pool[slot, 0, at : at + LAYER], pool[slot, 1, at : at + LAYER]
                _add_layer(words, sign, reject, lanes, totals, weights)
            used[slot] += sign
            if used[slot] >= MOST_FRAMES:
                pool[slot] //= 2
                used[slot] //= 2
                halved += 1
    return halved


@njit(cache=True, nogil=True)
@no_type_check
def _fixed_size(frames, box):
    """Columns and rows of the averaged frame, in fixed point; the last may be a part."""
    columns, rows = (frames.shape[2] * ONE) // box[1], (frames.shape[1] * ONE) // box[0]
    return np.uint32(columns), np.uint32(rows)


@njit(cache=True, nogil=True)
@no_type_check
def _corner(matrix, brick):
    """Fixed-point place of a brick's first voxel, from the exact position."""
    x, y, z = brick[0] * 8.0, brick[1] * 8.0, brick[2] * 8.0
    u = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
    v = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
    d = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    return (
        np.int64(math.floor(u + 0.5)),
        np.int64(math.floor(v + 0.5)),
        np.int64(math.floor(d + 0.5)),
    )


@njit(cache=True, nogil=True)
@no_type_check
def finish_bytes(pool, slots, bricks, order, size, turn, clear, voxels, coverage):
    """Write the means of bricks into the volume; ``clear`` empties them for others."""
    means, counts = np.empty(VOXELS, np.uint8), np.empty(VOXELS, np.uint8)
    for p in range(turn[0], slots.size, turn[1]):
        totals, weights = pool[slots[p], 0], pool[slots[p], 1]
        for lane in range(VOXELS):
            weight = weights[lane]
            divisor = np.float32(max(np.int32(weight * 16), np.int32(16)))
            mean = np.int32(np.float32(totals[lane]) / divisor + np.float32(0.5))
            means[lane] = np.uint8(mean)
            counts[lane] = _frames_of_weight(weight)
        _write_brick(means, counts, bricks[p], order, size, voxels, coverage)
        if clear:
            pool[slots[p]] = 0


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _frames_of_weight(weight):
    """Whole frames that a sum of weights stands for, rounded up, at most 255."""
    # Division by 63 as a product, exact up to 255 frames: divisions are not vectorized.
    most = np.int32(255 * FULL_WEIGHT)
    return np.uint8(np.int32((min(weight, most) + np.int32(62)) * np.int32(16645)) >> 20)


@njit(cache=True, nogil=True)
@no_type_check
def _write_brick(means, counts, brick, order, size, voxels, coverage):
    """Copy a brick to its place in a volume, as far as it lies inside."""
    stride = np.array([1, size[0], size[0] * size[1]])
    slow, mid, fast = order[0], order[1], order[2]
    corner = BRICK * (brick[0] * stride[0] + brick[1] * stride[1] + brick[2] * stride[2])
    layers = min(BRICK, size[slow] - brick[slow] * BRICK)
    rows = min(BRICK, size[mid] - brick[mid] * BRICK)
    columns = min(BRICK, size[fast] - brick[fast] * BRICK)
    step = stride[fast]
    for k in range(layers):
        for j in range(rows):
            at = corner + k * stride[slow] + j * stride[mid]
            lane = k * LAYER + j * BRICK
            if step == 1 and columns == BRICK:
                gray, seen = voxels[at : at + BRICK], coverage[at : at + BRICK]
                for i in range(BRICK):
                    gray[i] = means[lane + i]
                for i in range(BRICK):
                    seen[i] = counts[lane + i]
            else:
                for i in range(columns):
                    voxels[at + i * step] = means[lane + i]
                    coverage[at + i * step] = counts[lane + i]


@njit(cache=True, nogil=True)
@no_type_check
def _average_general(frame, box, padded):
    """Fill the means of boxes of one channel inside a rim that repeats the edge."""
    rows, columns = padded.shape[0] - 2, padded.shape[1] - 2
    for j in range(rows):
        for i in range(columns):
            total, count = 0.0, 0
            for row in range(j * box[0], min((j + 1) * box[0], frame.shape[0])):
                for column in range(i * box[1], min((i + 1) * box[1], frame.shape[1])):
                    total += frame[row, column]
                    count += 1
            padded[j + 1, i + 1] = total / count
    for j in range(rows):
        padded[j + 1, 0], padded[j + 1, columns + 1] = padded[j + 1, 1], padded[j + 1, columns]
    for i in range(columns + 2):
        padded[0, i], padded[rows + 1, i] = padded[1, i], padded[rows, i]


@njit(cache=True, nogil=True)
@no_type_check
def gather_general(
    frames,
    box,
    kept,
    fixed,
    peaks,
    first,
    numbers,
    bricks,
    slot_of,
    order,
    turn,
    sign,
    reject,
    weight,
    total,
):
    """Add frames of any type and number of channels, or take them out.

    As :func:`gather_bytes`, with channels last in ``frames``, ``reject`` a gray level, and
    sums in double precision, which are exact for 16-bit pixels without a prefilter:
    ``weight`` is ``(slots, 512)``, ``total`` is ``(slots, channels, 512)``. Voxels near
    pixels that are not finite do not count.
    """
    rows, columns = -(-frames.shape[1] // box[0]), -(-frames.shape[2] // box[1])
    width, outside = np.int32(columns + 1), np.int32((rows + 1) * (columns + 1))
    size = _fixed_size(frames, box)
    channels = frames.shape[3]
    padded = np.empty((channels, rows + 2, columns + 2))
    lanes, steps = np.empty(LANES, np.int32), np.empty((3, 3), np.int32)
    slow, mid = order[0], order[1]
    for f in range(frames.shape[0]):
        if first[f] == first[f + 1] or peaks[f] < 0:
            continue
        for channel in range(channels):
            _average_general(frames[f, :, :, channel], box, padded[channel])
        peak = np.int32(peaks[f])
        middle, span = _fill_steps(fixed[f], mid, order[2], steps, lanes)
        for p in range(first[f], first[f + 1]):
            brick = bricks[numbers[p]]
            if (brick[slow] + brick[mid]) % turn[1] != turn[0]:
                continue
            slot = slot_of[numbers[p]]
            u, v, d = _corner(fixed[f], brick)
            for layer in range(BRICK):
                height = d + layer * steps[2, slow]
                if abs(height + middle) > span + peak:
                    continue
                across = np.int32(u + layer * steps[0, slow])
                down = np.int32(v + layer * steps[1, slow])
                _locate(across, down, np.int32(height), peak, size, width, outside, lanes)
                at = layer * LAYER
                weights, totals = weight[slot, at : at + LAYER], total[slot, :, at : at + LAYER]
                _add_general(padded, kept, outside, width, sign, reject, lanes, weights, totals)


@njit(cache=True, nogil=True)
@no_type_check
def _add_general(padded, kept, outside, width, sign, reject, lanes, weights, totals):
    """Sample the cells and add to the sums of a layer."""
    sample = np.empty(totals.shape[0])
    for lane in range(LAYER):
        cell = lanes[_CELL + lane]
        if lanes[_WEIGHT + lane] == 0 or cell == outside:
            continue
        if kept.size > 0 and not kept[cell]:
            continue
        if _sample(padded, cell, width, lanes[_FRACTION + lane], reject, sample):
            share = lanes[_WEIGHT + lane] * sign
            weights[lane] += share
            for channel in range(sample.size):
                totals[channel, lane] += share * sample[channel]


@njit(cache=True, nogil=True)
@no_type_check
def _sample(padded, cell, width, fraction, reject, sample):
    """Interpolate all channels in a cell; says whether the sample counts."""
    j, i = cell // width, cell % width
    across, down = fraction & 15, fraction >> 4
    counts = False
    for channel in range(sample.size):
        image = padded[channel]
        upper = image[j, i] * (16 - across) + image[j, i + 1] * across
        lower = image[j + 1, i] * (16 - across) + image[j + 1, i + 1] * across
        sample[channel] = (upper * (16 - down) + lower * down) / 256
        if not math.isfinite(sample[channel]):
            return False
        counts |= sample[channel] >= reject
    return counts


@njit(cache=True, nogil=True)
@no_type_check
def finish_general(
    weight, total, slots, bricks, order, size, turn, clear, rounding, voxels, coverage
):
    """Write the means of bricks, ``(voxels, channels)``; ``rounding`` is 0 for floats."""
    stride = np.array([1, size[0], size[0] * size[1]])
    place = np.empty(3, np.int64)
    for p in range(turn[0], slots.size, turn[1]):
        slot = slots[p]
        for lane in range(VOXELS):
            seen = weight[slot, lane]
            place[order[0]] = bricks[p, order[0]] * BRICK + lane // LAYER
            place[order[1]] = bricks[p, order[1]] * BRICK + (lane // BRICK) % BRICK
            place[order[2]] = bricks[p, order[2]] * BRICK + lane % BRICK
            if seen <= 0 or place[0] >= size[0] or place[1] >= size[1] or place[2] >= size[2]:
                continue
            at = place[0] + place[1] * stride[1] + place[2] * stride[2]
            coverage[at] = np.uint8(min((seen + FULL_WEIGHT - 1) // FULL_WEIGHT, 255))
            for channel in range(total.shape[1]):
                mean = total[slot, channel, lane] / seen
                if rounding > 0:
                    mean = math.floor(mean + rounding)
                voxels[at, channel] = mean
        if clear:
            weight[slot] = 0
            total[slot] = 0
