"""Triton kernels: compositing of sorted Gaussians and its gradient, blending, Adam, smoothing.

They are the inner loops only. What they must compute is written down in ``reference.py`` and ``fused.py``; without
a GPU they run in Triton's interpreter (``TRITON_INTERPRET=1``), which is how they are tested there.

The compositing kernels give one program to each strip of a tile: ``ROWS`` rows of pixels, so few that one warp
holds them and sums over pixels need no barrier.
"""
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

import triton
import triton.language as tl

CHECK_EVERY = tl.constexpr(32)
"""Gaussians between two looks at whether any pixel of the strip still goes on."""


@triton.jit
def _pixels(strip, width, height, tiles_x, TILE: tl.constexpr, ROWS: tl.constexpr, PIXELS: tl.constexpr):
    """Place of each pixel of a strip, its index in the image, and whether it is inside."""
    strips = (TILE + ROWS - 1) // ROWS
    tile = strip // strips
    lane = tl.arange(0, PIXELS)
    row = (strip % strips) * ROWS + lane // TILE
    x = (tile % tiles_x) * TILE + lane % TILE
    y = (tile // tiles_x) * TILE + row
    inside = (lane < TILE * ROWS) & (row < TILE) & (x < width) & (y < height)
    return tile, x.to(tl.float32), y.to(tl.float32), y * width + x, inside


@triton.jit
def _falloff(record, x, y):
    """Offsets from the Gaussian's centre, its conic and the exponent of its falloff at each pixel."""
    dx = tl.load(record) - x
    dy = tl.load(record + 1) - y
    xx = tl.load(record + 2)
    xy = tl.load(record + 3)
    yy = tl.load(record + 4)
    return dx, dy, xx, xy, yy, -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy


@triton.jit
def composite_forward(
    records, starts, color, transmittance, stops,
    width, height, tiles_x, alpha_min, alpha_max, transmittance_min,
    FIELDS: tl.constexpr, TILE: tl.constexpr, ROWS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Front to back over the list of a tile.

    Args:
        records: one row of ``FIELDS`` floats per entry of the lists: centre, conic, opacity, colour.
        starts: where the list of each tile begins, and behind them where the last one ends.
        color: over black, out.
        transmittance: what is left of it, out.
        stops: entry at which a pixel stopped, out; the end of the list where it did not.
        width: of the image, px.
        height: of the image, px.
        tiles_x: tiles in a row.
        alpha_min: see ``RasterConstants``.
        alpha_max: likewise.
        transmittance_min: likewise.
        FIELDS: floats per record.
        TILE: side of a tile, px.
        ROWS: rows of a strip.
        PIXELS: power of two that holds a strip.
    """
    tile, x, y, pixel, inside = _pixels(tl.program_id(0), width, height, tiles_x, TILE, ROWS, PIXELS)
    entry = tl.load(starts + tile)
    end = tl.load(starts + tile + 1)
    T = tl.full((PIXELS,), 1.0, tl.float32)
    red, green, blue = T * 0.0, T * 0.0, T * 0.0
    stop = tl.where(inside, end, entry)
    while (entry < end) & (tl.max(stop, 0) > entry):
        until = tl.minimum(entry + CHECK_EVERY, end)
        for i in range(entry, until):
            record = records + i * FIELDS
            _dx, _dy, _xx, _xy, _yy, exponent = _falloff(record, x, y)
            raw = tl.load(record + 5) * tl.exp(tl.minimum(exponent, 0.0))
            alpha = tl.minimum(raw, alpha_max)
            drawn = (i < stop) & (exponent <= 0.0) & (alpha >= alpha_min)
            after = T * (1.0 - alpha)
            ends = drawn & (after < transmittance_min)
            stop = tl.where(ends, i, stop)
            weight = tl.where(drawn & (after >= transmittance_min), alpha * T, 0.0)
            red += weight * tl.load(record + 6)
            green += weight * tl.load(record + 7)
            blue += weight * tl.load(record + 8)
            T = tl.where(drawn & (after >= transmittance_min), after, T)
        entry = until
    tl.store(color + pixel * 3, red, mask=inside)
    tl.store(color + pixel * 3 + 1, green, mask=inside)
    tl.store(color + pixel * 3 + 2, blue, mask=inside)
    tl.store(transmittance + pixel, T, mask=inside)
    tl.store(stops + pixel, stop, mask=inside)


@triton.jit
def composite_backward(
    records, starts, slots, transmittance, stops, v_color, v_transmittance, v_statistic, gradients,
    width, height, tiles_x, alpha_min, alpha_max,
    FIELDS: tl.constexpr, COLUMNS: tl.constexpr, TILE: tl.constexpr, ROWS: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    """Back to front over the list of a tile, undoing the transmittance by division.

    Every strip writes what it adds to a Gaussian's gradient into a row of its own, so that nothing is added up in
    an order that changes from run to run.

    Args:
        records: as in ``composite_forward``, like all that is not said here.
        starts: lists of the tiles.
        slots: number of the first row of ``gradients`` of each entry, per strip of a tile.
        transmittance: that of the forward pass.
        stops: those of the forward pass.
        v_color: gradient of the loss for the colour over black.
        v_transmittance: gradient of the loss for what is left.
        v_statistic: that part of it which comes through the colour image.
        gradients: rows of ``COLUMNS`` floats: gradients of a record's fields, then of the centre without the loss
            of the opacity image (which ``v_statistic`` leaves out). Rows never written must be zero.
        width: of the image, px.
        height: of the image, px.
        tiles_x: tiles in a row.
        alpha_min: see ``RasterConstants``.
        alpha_max: likewise.
        FIELDS: floats per record.
        COLUMNS: floats per row of ``gradients``.
        TILE: side of a tile, px.
        ROWS: rows of a strip.
        PIXELS: power of two that holds a strip.
    """
    strips = (TILE + ROWS - 1) // ROWS
    strip = tl.program_id(0)
    tile, x, y, pixel, inside = _pixels(strip, width, height, tiles_x, TILE, ROWS, PIXELS)
    first = tl.load(starts + tile)
    stop = tl.load(stops + pixel, mask=inside, other=0)
    T = tl.load(transmittance + pixel, mask=inside, other=1.0)
    v_red = tl.load(v_color + pixel * 3, mask=inside, other=0.0)
    v_green = tl.load(v_color + pixel * 3 + 1, mask=inside, other=0.0)
    v_blue = tl.load(v_color + pixel * 3 + 2, mask=inside, other=0.0)
    behind = T * tl.load(v_transmittance + pixel, mask=inside, other=0.0)
    behind_statistic = T * tl.load(v_statistic + pixel, mask=inside, other=0.0)
    last = tl.max(tl.where(inside, stop, 0), 0)
    for back in range(0, tl.maximum(last - first, 0)):
        i = last - 1 - back
        record = records + i * FIELDS
        dx, dy, xx, xy, yy, exponent = _falloff(record, x, y)
        falloff = tl.exp(tl.minimum(exponent, 0.0))
        raw = tl.load(record + 5) * falloff
        alpha = tl.minimum(raw, alpha_max)
        drawn = inside & (i < stop) & (exponent <= 0.0) & (alpha >= alpha_min)
        if tl.max(drawn.to(tl.int32), 0) > 0:
            alpha = tl.where(drawn, alpha, 0.0)
            before = T / (1.0 - alpha)
            weight = alpha * before
            pull = v_red * tl.load(record + 6) + v_green * tl.load(record + 7) + v_blue * tl.load(record + 8)
            v_alpha = tl.where(drawn, before * pull - behind / (1.0 - alpha), 0.0)
            v_alpha_statistic = tl.where(drawn, before * pull - behind_statistic / (1.0 - alpha), 0.0)
            behind += weight * pull
            behind_statistic += weight * pull
            T = before
            # The clamp of opacity is ignored: raw takes the gradient of alpha.
            v_exponent = v_alpha * raw
            toward_x, toward_y = xx * dx + xy * dy, yy * dy + xy * dx
            v_statistic_exponent = v_alpha_statistic * raw
            slot = tl.load(slots + i).to(tl.int64) * strips + strip % strips
            row = gradients + slot * COLUMNS
            tl.store(row, -tl.sum(v_exponent * toward_x, 0))
            tl.store(row + 1, -tl.sum(v_exponent * toward_y, 0))
            tl.store(row + 2, -0.5 * tl.sum(v_exponent * dx * dx, 0))
            tl.store(row + 3, -tl.sum(v_exponent * dx * dy, 0))
            tl.store(row + 4, -0.5 * tl.sum(v_exponent * dy * dy, 0))
            tl.store(row + 5, tl.sum(v_alpha * falloff, 0))
            tl.store(row + 6, tl.sum(weight * v_red, 0))
            tl.store(row + 7, tl.sum(weight * v_green, 0))
            tl.store(row + 8, tl.sum(weight * v_blue, 0))
            tl.store(row + 9, -tl.sum(v_statistic_exponent * toward_x, 0))
            tl.store(row + 10, -tl.sum(v_statistic_exponent * toward_y, 0))


@triton.jit
def sum_rows(rows, starts, sums, COLUMNS: tl.constexpr, WIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Sum of consecutive rows: those of Gaussian g are ``starts[g]`` to ``starts[g + 1]``.

    Args:
        rows: of ``COLUMNS`` floats.
        starts: first row of each Gaussian, and behind them the number of rows.
        sums: one row per Gaussian, out.
        COLUMNS: floats per row.
        WIDE: power of two that holds a row.
        BLOCK: rows at once.
    """
    gaussian = tl.program_id(0)
    row = tl.load(starts + gaussian)
    end = tl.load(starts + gaussian + 1)
    column = tl.arange(0, WIDE)[None, :]
    total = tl.zeros((BLOCK, WIDE), tl.float32)
    while row < end:
        place = row + tl.arange(0, BLOCK)[:, None]
        total += tl.load(rows + place * COLUMNS + column, mask=(place < end) & (column < COLUMNS), other=0.0)
        row += BLOCK
    lane = tl.arange(0, WIDE)
    tl.store(sums + gaussian.to(tl.int64) * COLUMNS + lane, tl.sum(total, 0), mask=lane < COLUMNS)


@triton.jit
def blend(base, deltas, psi, out, k, p, BLOCK: tl.constexpr):
    """Linear blend: base + Σ psi_k deltas_k; rows whose psi_k is 0 are not read."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = place < p
    total = tl.load(base + place, mask=inside, other=0.0)
    row = deltas + place
    for index in range(0, k):
        weight = tl.load(psi + index)
        read = place < tl.where(weight != 0.0, p, 0)
        total += weight * tl.load(row, mask=read, other=0.0).to(tl.float32)
        row += p
    tl.store(out + place, total, mask=inside)


@triton.jit
def adam(
    parameters, first_moment, second_moment, psi, gradient, learning_rates, scale,
    p, start, count, n, rows, per_gaussian, factor, eps, first_gain, second_gain,
    BETA1: tl.constexpr, BETA2: tl.constexpr, SCALED: tl.constexpr, SKIP: tl.constexpr, FRAMES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Adam on columns ``start`` to ``start + count`` of each row with the gradient psi_k·g, summed over the frames.

    Args:
        parameters: rows of ``p`` floats, changed in place like both moments.
        first_moment: running mean of the gradient.
        second_moment: running mean of its square.
        psi: one factor per row, for each frame.
        gradient: g of each frame, ``p`` floats.
        learning_rates: ``p`` floats.
        scale: rows of ``n`` factors of the step; where one is 0 nothing changes. Not read unless ``SCALED``.
        p: floats per row.
        start: first column.
        count: columns.
        n: Gaussians.
        rows: number of rows.
        per_gaussian: floats of each Gaussian among the columns.
        factor: of all learning rates.
        eps: added to the root of the second moment.
        first_gain: 1 / (1 - BETA1^step).
        second_gain: 1 / (1 - BETA2^step).
        BETA1: decay of the first moment; a constant, because 1 - BETA2 needs more digits than float32 has.
        BETA2: decay of the second moment.
        SCALED: whether there is a scale.
        SKIP: leave rows with psi_k = 0 in all frames as they are.
        FRAMES: number of frames.
        BLOCK: columns at once.
    """
    k = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = place < count
    if SKIP:
        active = tl.abs(tl.load(psi + k))
        for frame in tl.static_range(1, FRAMES):
            active += tl.abs(tl.load(psi + frame * rows + k))
        live = place < tl.where(active != 0.0, count, 0)
    column = start + place
    rate = factor * tl.load(learning_rates + column, mask=live, other=0.0)
    if SCALED:
        rate *= tl.load(scale + k * n + place // per_gaussian, mask=live, other=0.0)
        live = live & (rate != 0.0)
    g = tl.load(psi + k) * tl.load(gradient + column, mask=live, other=0.0)
    for frame in tl.static_range(1, FRAMES):
        weight = tl.load(psi + frame * rows + k)
        g += weight * tl.load(gradient + frame * p + column, mask=live, other=0.0)
    cell = k * p + column
    first = BETA1 * tl.load(first_moment + cell, mask=live, other=0.0) + (1.0 - BETA1) * g
    second = BETA2 * tl.load(second_moment + cell, mask=live, other=0.0) + (1.0 - BETA2) * g * g
    step = rate * first * first_gain / (tl.sqrt_rn(second * second_gain) + eps)
    value = tl.load(parameters + cell, mask=live, other=0.0)
    tl.store(first_moment + cell, first, mask=live)
    tl.store(second_moment + cell, second, mask=live)
    tl.store(parameters + cell, value - step, mask=live)


@triton.jit
def smooth(images, window, out, n, length, stride, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """One-dimensional convolution with a symmetric window along one axis; zeros outside.

    Args:
        images: ``n`` floats.
        window: ``TAPS`` weights, an odd number.
        out: like ``images``.
        n: number of floats.
        length: of the axis.
        stride: floats between neighbours along the axis.
        TAPS: length of the window.
        BLOCK: floats at once.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    along = (place // stride) % length
    total = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(TAPS):
        reach = tap - TAPS // 2
        inside = (place < n) & (along + reach >= 0) & (along + reach < length)
        total += tl.load(window + tap) * tl.load(images + place + reach * stride, mask=inside, other=0.0)
    tl.store(out + place, total, mask=place < n)


@triton.jit
def _inverse_transpose(a, b, c, d, e, f, g, h, i):
    """M⁻ᵀ of the matrix with rows abc, def, ghi: cofactors over determinant."""
    A, B, C = e * i - f * h, f * g - d * i, d * h - e * g
    D, E, F = h * c - i * b, i * a - g * c, g * b - h * a
    G, H, I = b * f - c * e, c * d - a * f, a * e - b * d  # noqa: E741
    r = 1.0 / (a * A + b * B + c * C)
    return A * r, B * r, C * r, D * r, E * r, F * r, G * r, H * r, I * r


@triton.jit
def _quaternion(a, b, c, d, e, f, g, h, i):
    """Unit quaternion of the rotation with rows abc, def, ghi, its largest component positive."""
    ww, xx, yy, zz = 1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i
    wx, wy, wz = h - f, c - g, d - b
    xy, xz, yz = d + b, c + g, h + f
    # The first of the largest wins, as with argmax.
    is_w = (ww >= xx) & (ww >= yy) & (ww >= zz)
    is_x = (xx >= yy) & (xx >= zz)
    is_y = yy >= zz
    w = tl.where(is_w, ww, tl.where(is_x, wx, tl.where(is_y, wy, wz)))
    x = tl.where(is_w, wx, tl.where(is_x, xx, tl.where(is_y, xy, xz)))
    y = tl.where(is_w, wy, tl.where(is_x, xy, tl.where(is_y, yy, yz)))
    z = tl.where(is_w, wz, tl.where(is_x, xz, tl.where(is_y, yz, zz)))
    largest = tl.where(is_w, ww, tl.where(is_x, xx, tl.where(is_y, yy, zz)))
    r = 0.5 / tl.sqrt_rn(largest)
    return w * r, x * r, y * r, z * r


@triton.jit
def skin_maps(weights, transforms, linear, shift, rotation, turn, n, JOINTS: tl.constexpr, BLOCK: tl.constexpr):
    """Blended joint maps and their rotation factors, three Newton steps of the polar decomposition.

    Args:
        weights: rows of ``JOINTS`` shares.
        transforms: ``JOINTS`` matrices 4×4.
        linear: 3×3 part of each Gaussian's map, out.
        shift: its translation, out.
        rotation: its rotation factor, out.
        turn: that as a quaternion, out.
        n: Gaussians.
        JOINTS: number of joints.
        BLOCK: Gaussians at once.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = place < n
    zero = tl.zeros((BLOCK,), tl.float32)
    a, b, c, d, e, f, g, h, i = zero, zero, zero, zero, zero, zero, zero, zero, zero
    x, y, z = zero, zero, zero
    for joint in tl.static_range(JOINTS):
        share = tl.load(weights + place * JOINTS + joint, mask=inside, other=0.0)
        matrix = transforms + joint * 16
        a += share * tl.load(matrix)
        b += share * tl.load(matrix + 1)
        c += share * tl.load(matrix + 2)
        x += share * tl.load(matrix + 3)
        d += share * tl.load(matrix + 4)
        e += share * tl.load(matrix + 5)
        f += share * tl.load(matrix + 6)
        y += share * tl.load(matrix + 7)
        g += share * tl.load(matrix + 8)
        h += share * tl.load(matrix + 9)
        i += share * tl.load(matrix + 10)
        z += share * tl.load(matrix + 11)
    _store9(linear + place * 9, a, b, c, d, e, f, g, h, i, inside)
    tl.store(shift + place * 3, x, mask=inside)
    tl.store(shift + place * 3 + 1, y, mask=inside)
    tl.store(shift + place * 3 + 2, z, mask=inside)
    for _step in tl.static_range(3):
        A, B, C, D, E, F, G, H, I = _inverse_transpose(a, b, c, d, e, f, g, h, i)  # noqa: E741
        a, b, c = 0.5 * (a + A), 0.5 * (b + B), 0.5 * (c + C)
        d, e, f = 0.5 * (d + D), 0.5 * (e + E), 0.5 * (f + F)
        g, h, i = 0.5 * (g + G), 0.5 * (h + H), 0.5 * (i + I)
    _store9(rotation + place * 9, a, b, c, d, e, f, g, h, i, inside)
    qw, qx, qy, qz = _quaternion(a, b, c, d, e, f, g, h, i)
    tl.store(turn + place * 4, qw, mask=inside)
    tl.store(turn + place * 4 + 1, qx, mask=inside)
    tl.store(turn + place * 4 + 2, qy, mask=inside)
    tl.store(turn + place * 4 + 3, qz, mask=inside)


@triton.jit
def _store9(matrix, a, b, c, d, e, f, g, h, i, inside):
    """Writes a 3×3 matrix row by row."""
    tl.store(matrix, a, mask=inside)
    tl.store(matrix + 1, b, mask=inside)
    tl.store(matrix + 2, c, mask=inside)
    tl.store(matrix + 3, d, mask=inside)
    tl.store(matrix + 4, e, mask=inside)
    tl.store(matrix + 5, f, mask=inside)
    tl.store(matrix + 6, g, mask=inside)
    tl.store(matrix + 7, h, mask=inside)
    tl.store(matrix + 8, i, mask=inside)
