"""Which pixels of a photograph show clear sky, and why the others do not.

Nothing is learnt and nothing is known of exposure or white balance: clear sky is what is *smooth*. A picture is looked at as
log luminance and log red/blue, in which an exposure and a white balance are constants to add.

1. Ground, trees, buildings, wires and birds have edges or texture: the picture is cut where it is rougher than its own
   noise, and of what is left the largest piece towards the zenith is sky, with all pieces that agree with it.
2. Clouds are redder than the sky around them, whatever their brightness: a smooth function of direction is fitted to log
   red/blue from below, as the lower edge of what is there, and what lies above it is cloud. The haze towards the horizon and
   the sun is white as well, but smooth, and the fit follows it (the ratio of red to blue is what sky cameras use: Long et
   al. 2006, J. Atmos. Oceanic Technol. 23, 633; a smooth clear-sky background that is taken off: Yang et al. 2016, Atmos.
   Meas. Tech. 9, 587).
3. The sun, what is clipped, and the star that a lens makes of it are left out with a margin.

A uniform layer of cloud is as smooth as a clear sky; it is told by its lack of colour and by its brightness, which falls
towards the horizon (CIE overcast sky: (1 + 2 sin e) / 3), where that of a clear sky grows.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from diffatmo import saturation as saturated

REASONS = ("sky", "not finite", "saturated", "below the horizon", "ground or object", "cloud", "sun and flare")
"""What a pixel shows, by its label."""

SKY, NOT_FINITE, SATURATED, BELOW, OBJECT, CLOUD, SUN = range(len(REASONS))

WORKING_SIZE = 1024
"""Pixels of the longer side that the picture is reduced to; the mask is enlarged again."""

SUN_RADIUS = np.radians(3.0)
"""Left out around the sun at least."""

GLARE_RADIUS = np.radians(10.0)
"""Within which what looks like cloud is counted as glare of the sun: nothing tells the two apart."""

FLARE_RADIUS = np.radians(25.0)
"""As far as a star or a ghost of the lens is looked for."""


LOW = np.radians(20.0)
"""Elevation below which haze lies in layers."""


class MaskError(ValueError):
    """A picture cannot be masked; the message says what would be right."""


class SkyMask(NamedTuple):
    """Which pixels of a picture show clear sky."""

    label: UInt8[np.ndarray, "height width"]
    """Index into ``reasons``; 0 is clear sky."""
    cloud_cover: float
    """Share of cloud in what is seen of the sky, 0 to 1; NaN where no sky is seen."""

    @property
    def sky(self) -> Bool[np.ndarray, "height width"]:
        """Where the picture shows clear sky that may be fitted."""
        return self.label == SKY

    @property
    def reasons(self) -> tuple[str, ...]:
        """Names of the labels."""
        return REASONS

    @property
    def overcast(self) -> bool:
        """Whether next to nothing of the sky is clear."""
        return self.cloud_cover > 0.9

    def counts(self) -> dict[str, int]:
        """Number of pixels by reason."""
        return dict(zip(REASONS, np.bincount(self.label.ravel(), minlength=len(REASONS)).tolist(), strict=True))


class Horizon(NamedTuple):
    """A straight line between sky and sea or plain."""

    row: float
    """Where it crosses the middle of the picture, in rows from the centre of the first."""
    slope: float
    """Rows down per column to the right."""
    confidence: float
    """Share of the columns in which the line is seen, 0 to 1."""

    def rows(self, width: int) -> Float[np.ndarray, " width"]:
        """Row of the line in every column of a picture ``width`` wide."""
        return self.row + self.slope * (np.arange(width) - (width - 1) / 2)


class _Features(NamedTuple):
    """A picture reduced to what is asked of it, all (rows, columns)."""

    luminance: np.ndarray
    """Mean log of the channels."""
    ratio: np.ndarray
    """Log of the first channel, red, over the last, blue."""
    roughness: np.ndarray
    """Root mean square of what a median over 5 × 5 pixels takes away from both."""
    lit: np.ndarray
    """Where there is light to take a logarithm of."""


# The whole ------------------------------------------------------------------------------------------------------------


def find_sky(
    pixels: Float[np.ndarray, "height width 3"],
    *,
    elevation: Float[np.ndarray, "height width"] | None = None,
    from_sun: Float[np.ndarray, "height width"] | None = None,
    saturation: float | None = None,
) -> SkyMask:
    """Find the clear sky in a picture of linear red, green, blue in any exposure and white balance.

    ``elevation``, rad, is what each pixel looks at, if the camera's pose is known; without it the top of the picture is
    taken to be up, and a straight horizon is looked for. ``from_sun``, rad, is the angle to the sun, if that is known.
    ``saturation`` is the value from which on a pixel is clipped; without it a plateau at the largest value counts as such.

    Always gives a mask, which may be empty. Raises :class:`MaskError` for arrays of the wrong shape.
    """
    pixels = _checked(pixels)
    for name, angle in (("elevation", elevation), ("from_sun", from_sun)):
        if angle is not None and np.shape(angle) != pixels.shape[:2]:
            raise MaskError(f"{name} of shape {np.shape(angle)}, expected that of the picture, {pixels.shape[:2]}")
    finite = np.isfinite(pixels).all(axis=-1)
    clipped = saturated.clipped(pixels, saturation=saturation)
    factor = -(-max(pixels.shape[:2]) // WORKING_SIZE)
    turns = elevation is not None and _is_panorama(np.asarray(elevation))
    small = _Small(
        pixels=_wrapped(_light(pixels, factor), turns),
        clipped=_wrapped(_reduced(clipped, factor) > 0, turns),
        elevation=None if elevation is None else _wrapped(_reduced(elevation, factor), turns),
        from_sun=None if from_sun is None else _wrapped(_reduced(from_sun, factor), turns),
        turns=turns,
    )
    found, cover = _label(small)
    columns = -(-pixels.shape[1] // factor)
    margin = (found.shape[1] - columns) // 2
    label = found[:, margin : margin + columns].repeat(factor, axis=0).repeat(factor, axis=1)
    label = label[: pixels.shape[0], : pixels.shape[1]]
    label[clipped] = SATURATED
    if elevation is not None:
        label[np.asarray(elevation) < 0] = BELOW
    label[~finite] = NOT_FINITE
    return SkyMask(label, cover)


def _checked(pixels: np.ndarray) -> np.ndarray:
    pixels = np.asarray(pixels, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or 0 in pixels.shape:
        raise MaskError(f"pixels of shape {pixels.shape}, expected (height, width, 3)")
    return pixels


class _Small(NamedTuple):
    """The picture at its working size; one that is a full turn goes on beyond its seam."""

    pixels: np.ndarray
    clipped: np.ndarray
    elevation: np.ndarray | None
    from_sun: np.ndarray | None
    turns: bool


def _label(small: _Small) -> tuple[np.ndarray, float]:
    """Labels at the working size, and the cloud cover."""
    if small.elevation is not None:
        rows = np.flatnonzero((small.elevation >= 0).any(axis=1))
        label = np.full(small.clipped.shape, BELOW, dtype=np.uint8)
        if rows.size == 0:
            return label, np.nan
        part = slice(rows[0], rows[-1] + 1)
        label[part], cover = _label_upper(
            small._replace(
                pixels=small.pixels[part],
                clipped=small.clipped[part],
                elevation=small.elevation[part],
                from_sun=None if small.from_sun is None else small.from_sun[part],
            )
        )
        return label, cover
    return _label_upper(small)


def _label_upper(small: _Small) -> tuple[np.ndarray, float]:
    seen = _features(small)
    above = _above(small, seen)
    label = np.full(above.shape, OBJECT, dtype=np.uint8)
    label[~above] = BELOW
    sun = _sun(small, seen, above)
    ground = ~above
    if small.elevation is None:
        ground[-1] = True
    else:
        ground |= small.elevation < np.radians(1)
    candidate = above & seen.lit & ~small.clipped & ~sun
    cover = np.nan
    if (overcast := _is_overcast(small, seen, candidate, above)) or not candidate.any():
        label[candidate] = CLOUD if overcast else OBJECT
        cover = 1.0 if overcast else np.nan
    else:
        sky, cloud = _clear(small, seen, candidate, ground)
        label[cloud] = CLOUD
        label[sky] = SKY
        if small.from_sun is not None:
            label[(label == CLOUD) & (small.from_sun < GLARE_RADIUS)] = SUN
            cloud = label == CLOUD
        weight = np.cos(small.elevation) if small.turns and small.elevation is not None else np.ones(label.shape)
        both = float(weight[sky].sum() + weight[cloud].sum())
        cover = float(weight[cloud].sum()) / both if both > 0 else np.nan
    label[sun] = SUN
    label[_dilated(small.clipped, 3) & above] = SATURATED
    return label, cover


# Arrays ---------------------------------------------------------------------------------------------------------------


def _reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Means of squares of ``factor`` pixels, the last row and column repeated where the sides are no multiples of it."""
    if factor == 1:
        return np.asarray(image, dtype=np.float32)
    height, width = image.shape[:2]
    pad = [(0, -height % factor), (0, -width % factor)] + [(0, 0)] * (image.ndim - 2)
    full = np.pad(np.asarray(image, dtype=np.float32), pad, mode="edge")
    tiles = full.reshape(full.shape[0] // factor, factor, full.shape[1] // factor, factor, *full.shape[2:])
    return tiles.mean(axis=(1, 3))


def _light(pixels: np.ndarray, factor: int) -> np.ndarray:
    """The picture at its working size, 1 at most; NaN where a pixel is not finite."""
    finite = np.isfinite(pixels).all(axis=-1, keepdims=True)
    peak = pixels.max(initial=0, where=finite)
    return _reduced(np.where(finite, pixels / (peak if peak > 0 else 1), np.nan), factor)


def _is_panorama(elevation: np.ndarray) -> bool:
    """Whether the picture is a full turn about the vertical: rows of one elevation that reach up to the zenith."""
    height, width = elevation.shape
    return width >= 2 * height and bool(np.ptp(elevation, axis=1).max() < 1e-3) and elevation.max() > np.radians(80)


def _wrapped(image: np.ndarray, turns: bool) -> np.ndarray:
    if not turns:
        return image
    columns = image.shape[1] // 8
    return np.concatenate([image[:, image.shape[1] - columns :], image, image[:, :columns]], axis=1)


def _blurred(image: np.ndarray, sigma: float | tuple[float, float]) -> np.ndarray:
    from skimage import filters

    return filters.gaussian(image.astype(np.float32), sigma=sigma, mode="nearest", preserve_range=True)


def _dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    from skimage import morphology

    return morphology.isotropic_dilation(mask, radius) if mask.any() else mask


def _features(small: _Small) -> _Features:
    from skimage import filters, morphology

    finite = np.isfinite(small.pixels).all(axis=-1)
    light = np.where(finite[..., None], small.pixels, 0)
    mean = light.mean(axis=-1)
    typical = np.median(mean[mean > 0]) if (mean > 0).any() else 1.0
    lit = finite & (light > 1e-6 * typical).all(axis=-1)
    logs = np.log(np.maximum(light, 1e-6 * typical))
    # A hole, and the ground where it is known to begin, have no edge: they are filled with what is around them.
    known = lit if small.elevation is None else lit & (small.elevation >= 0)
    coarse = max(lit.shape) < WORKING_SIZE / 2
    share = _blurred(known, 3)
    square = morphology.footprint_rectangle((3, 3) if coarse else (5, 5))
    maps, rough = [], []
    for image in (logs.mean(axis=-1), logs[..., 0] - logs[..., 2]):
        near = _blurred(np.where(known, image, 0), 3) / np.maximum(share, 1e-6)
        filled = np.where(known | (share < 1e-3), image, near).astype(np.float32)
        fine = filled - filters.median(filled, square, mode="nearest")
        maps.append(filled)
        rough.append((fine - _layers(fine, small, known)) ** 2)
    luminance, ratio = maps
    return _Features(luminance, ratio, np.sqrt(_blurred(rough[0] + rough[1], 0.8 if coarse else 1.5)), lit)


# Where there can be sky -----------------------------------------------------------------------------------------------


def _above(small: _Small, seen: _Features) -> np.ndarray:
    if small.elevation is not None:
        return small.elevation >= 0
    line = _horizon(seen)
    rows = np.arange(seen.lit.shape[0])[:, None]
    return np.ones(seen.lit.shape, bool) if line is None else rows < line.rows(seen.lit.shape[1])[None, :] - 1


def _height(small: _Small, above: np.ndarray) -> np.ndarray:
    """From 0 at the horizon to 1 at the zenith, or from the lowest of what is ``above`` to the top of the picture."""
    if small.elevation is not None:
        return np.sin(np.maximum(small.elevation, 0))
    depth = above.sum(axis=0)
    return np.maximum(1 - (np.arange(above.shape[0])[:, None] + 0.5) / np.maximum(depth, 1), 0)


def _sun(small: _Small, seen: _Features, above: np.ndarray) -> np.ndarray:
    """The disc of the sun and the star of the lens; without its place, clipped spots that light their surroundings."""
    from skimage import measure

    if small.from_sun is None:
        spots = measure.label(small.clipped & above)
        level = seen.luminance[small.clipped].min() if small.clipped.any() else 0.0
        sun = np.zeros(above.shape, dtype=bool)
        for spot in measure.regionprops(spots):
            if spot.area >= 25:
                inside = spots == spot.label
                around = _dilated(inside, 5) & ~_dilated(inside, 2) & ~small.clipped & above
                if around.any() and np.median(seen.luminance[around]) > level - 0.5:
                    sun |= _dilated(inside, min(np.sqrt(spot.area), 40))
        return sun & above
    sun = small.from_sun < SUN_RADIUS
    if sun.any():
        # What is clipped or rough and hangs together with the disc, unless it stands on the ground.
        rough = above & (small.clipped | (seen.roughness > _threshold(seen, above)))
        pieces = measure.label((rough & (small.from_sun < FLARE_RADIUS)) | sun)
        star = np.isin(pieces, pieces[sun])
        grounded = star & (_height(small, above) < np.sin(np.radians(4)))
        reach = FLARE_RADIUS if not grounded.any() else 2.5 * SUN_RADIUS
        sun |= _dilated(star & (small.from_sun < reach), 2)
    return sun


def _threshold(seen: _Features, where: np.ndarray) -> float:
    """Roughness that is more than the picture's noise."""
    quiet = np.percentile(seen.roughness[where & seen.lit], 30) if (where & seen.lit).any() else 0.0
    return float(np.clip(3 * quiet, 0.03, 0.12))


# Clear sky and clouds -------------------------------------------------------------------------------------------------


def _clear(small: _Small, seen: _Features, candidate: np.ndarray, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clear sky and cloud."""
    from skimage import filters, measure

    nothing = np.zeros(candidate.shape, dtype=bool)
    threshold = _threshold(seen, candidate)
    # Noise passes the threshold here and there; what is more is stronger somewhere.
    quiet = candidate & ~filters.apply_hysteresis_threshold(seen.roughness * candidate, threshold, 1.5 * threshold)
    pieces = measure.label(quiet, connectivity=1)
    regions = [piece for piece in measure.regionprops(pieces) if piece.area >= 30]
    if not regions:
        return nothing, nothing
    # The largest piece, and the highest; but between two of them the bluer one, because the other may be cloud.
    height = _height(small, ~ground)
    size = np.array([height[tuple(piece.coords.T)].sum() for piece in regions])
    red = np.array([np.median(seen.ratio[tuple(piece.coords.T)]) for piece in regions])
    large = size > 0.05 * size.max()
    largest = regions[int(np.argmax(size * np.exp((red[large].min() - red) / 0.1) * large))]
    if largest.area < 0.01 * candidate.sum():
        return nothing, nothing
    basis = _basis(small)
    sky, white = _joined(seen, pieces == largest.label, regions)
    redder, brighter = (image - _lower_edge(image, basis, sky) for image in (seen.ratio, seen.luminance))
    redder = redder - _layers(redder, small, sky, share=25.0)
    # What is rough and stands clear of the ground is cloud if it is red and bright enough for one.
    rough = candidate & ~sky
    rest = measure.label(_dilated(rough, 1) | ground)
    grounded = np.isin(rest, rest[ground])
    free = rough & ~(grounded & (height < 0.4))
    thick = free & ((redder > 0.05) & (brighter > -0.3) | white)
    thick = free & _dilated(thick, 5)
    thin = sky & _is_mottled(redder, small, sky, thick)
    return sky & ~thin & ~_dilated(rough, 1), thin | thick


def _joined(seen: _Features, sky: np.ndarray, regions: list) -> tuple[np.ndarray, np.ndarray]:
    """The sky with the pieces that look like it across the gap, one after the other; and the pieces that are redder: cloud."""
    white = np.zeros_like(sky)
    left = [piece for piece in regions if not sky[tuple(piece.coords[0])]]
    for _ in range(4):
        share = np.maximum(_blurred(sky, 5), 1e-6)
        redder, brighter = (
            image - _blurred(np.where(sky, image, 0), 5) / share for image in (seen.ratio, seen.luminance)
        )
        joined = sky.copy()
        waiting = []
        for piece in left:
            inside = tuple(piece.coords.T)
            border = share[inside] > 0.01
            if border.sum() < 5:
                waiting.append(piece)
                continue
            red, bright = (float(np.median(image[inside][border])) for image in (redder, brighter))
            joined[inside] = abs(red) < 0.1 and abs(bright) < 0.35
            white[inside] = red >= 0.1 and bright > -0.3
        left = waiting
        if not left or np.array_equal(joined, sky):
            break
        sky = joined
    return joined, white


def _layers(image: np.ndarray, small: _Small, where: np.ndarray, share: float = 50.0) -> np.ndarray:
    """What lies in layers: the median by elevation over the lowest 20 degrees, fading out above 15."""
    if small.elevation is None:
        return np.zeros_like(image)
    low = where & (small.elevation >= 0) & (small.elevation < LOW)
    number = (small.elevation[low] / np.radians(0.5)).astype(int)
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    groups = [group for group in np.split(order, starts)[1:] if group.size >= 20]
    if not groups:
        return np.zeros_like(image)
    nodes = [float(small.elevation[low][group].mean()) for group in groups]
    medians = np.array([float(np.percentile(image[low][group], share)) for group in groups])
    fade = np.clip((LOW - np.array(nodes)) / np.radians(5), 0, 1)
    return np.interp(small.elevation, nodes, medians * fade).astype(np.float32)


def _is_mottled(redder: np.ndarray, small: _Small, sky: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """Where the sky is redder than it should be and varies over one to five degrees, or goes on from there or from ``cloud``.

    Along the horizon of a panorama only what varies from column to column counts, which layers of haze and the belt of
    twilight do not.
    """
    from skimage import measure

    near, far = max(1.0, redder.shape[1] / 600), max(3.0, redder.shape[1] / 100)

    def mean(image: np.ndarray, sigma: float | tuple[float, float]) -> np.ndarray:
        return _blurred(np.where(sky, image, 0), sigma) / np.maximum(_blurred(sky, sigma), 1e-3)

    def texture(*shape: float) -> np.ndarray:
        # This difference of means passes over slopes and parabolas: G(σ) f = f + σ²/2 f'' + …
        wide = np.maximum(near, far * np.array(shape)), np.maximum(near, np.sqrt(2) * far * np.array(shape))
        background = 2 * mean(redder, tuple(wide[0])) - mean(redder, tuple(wide[1]))
        return np.sqrt(mean((smoothed - background) ** 2, far))

    smoothed = mean(redder, near)
    strength = texture(1, 1)
    if small.turns and small.elevation is not None:
        strength = np.where(small.elevation < LOW, np.minimum(strength, texture(0, 1)), strength)
    least = max(0.022, 3 * float(np.median(strength[sky])))
    scatter = 1.4826 * float(np.median(np.abs(smoothed[sky])))
    above = sky & (smoothed > max(0.03, 2 * scatter))
    seeds = above & (strength > least)
    thin = above & (strength > 0.4 * least) & _dilated(seeds, round(2 * far))
    if small.from_sun is None:
        return thin
    # A large cloud is smooth inside. Where the sun is not known, so may be the glow around it.
    inside = measure.label(sky & ((smoothed > 0.2) | seeds))
    return thin | ((inside > 0) & np.isin(inside, inside[seeds | (_dilated(cloud, 8) & (inside > 0))]))


def _lower_edge(image: np.ndarray, basis: np.ndarray, where: np.ndarray) -> np.ndarray:
    """A smooth function fitted to an image from below.

    At first what lies above it counts for little, so that it finds the sky between clouds even where these are most of what
    there is; then not at all, where it is more than twice the scatter below.
    """
    chosen = np.flatnonzero(where.ravel())
    chosen = chosen[:: max(1, chosen.size // 5000)]
    rows, values = basis.reshape(-1, basis.shape[-1])[chosen].astype(np.float64), image.ravel()[chosen]
    rows = rows / (scale := np.sqrt((rows**2).mean(axis=0)) + 1e-12)
    # A little stiff, but for the first function, which is the constant.
    ridge = np.diag(np.where(np.arange(scale.size) > 0, 1e-4, 1e-9))
    weight = np.ones(values.size)
    for step in range(12):
        heavy = rows * weight[:, None]
        # Sums, not matrix products: threads that wait for each other make those of this size a hundred times slower.
        gram, right = np.einsum("ni,nj->ij", heavy, rows), np.einsum("ni,n->i", heavy, values)
        factors = np.linalg.solve(gram + weight.sum() * ridge, right)
        left = values - np.einsum("ni,i->n", rows, factors)
        spread = 1.4826 * float(np.median(-left[left < 0])) if (left < 0).any() else 0.0
        weight = np.where(left > 0, 0.02, 1.0) if step < 8 else np.where(left < 2 * spread + 1e-3, 1.0, 1e-9)
    return np.einsum("yxi,i->yx", basis, (factors / scale).astype(np.float32))


def _basis(small: _Small) -> np.ndarray:
    """Smooth functions of direction, (rows, columns, n), that can follow a clear sky's colour."""
    height, width = small.clipped.shape
    x = np.broadcast_to(np.linspace(-1, 1, width)[None, :], (height, width))
    y = np.broadcast_to(np.linspace(-1, 1, height)[:, None], (height, width))
    one = np.ones((height, width))
    if small.elevation is None:
        along = [x**i * y**j for i in range(5) for j in range(5 - i)]
        across = [one]
    else:
        sine = np.sin(np.maximum(small.elevation, 0))
        along = [one, sine, np.exp(-sine / 0.25), np.exp(-sine / 0.07)]
        across = [one, x, y, x * x, x * y]
        if small.turns:
            azimuth = 2 * np.pi * np.arange(width) / (width * 0.8)
            across = [one, *(wave(k * azimuth) * one for k in (1, 2) for wave in (np.cos, np.sin))]
    if small.from_sun is not None:
        angle = small.from_sun
        sunward = [np.cos(angle), np.cos(angle) ** 2, np.exp(-angle / 0.5), np.exp(-angle / 0.15)]
        across = [one, *sunward] if small.elevation is not None else across
        along = along + sunward if small.elevation is None else along
    return np.stack([a * b for a in along for b in across], axis=-1).astype(np.float32)


def _is_overcast(small: _Small, seen: _Features, candidate: np.ndarray, above: np.ndarray) -> bool:
    """Whether all of the sky is of one colour, and no brighter at the horizon than higher up."""
    height = _height(small, above)
    sky = candidate & (height > (0.17 if small.elevation is not None else 0.5))
    if small.from_sun is not None:
        sky &= small.from_sun > np.radians(15)
    if sky.sum() < 100:
        return False
    ratio = _blurred(seen.ratio, 3)[sky]
    low, middle, high = np.percentile(ratio, [5, 50, 95])
    if high - low > 0.2 or ((np.ptp(height[sky]) < 0.6 or small.elevation is None) and middle < -0.2):
        return False
    slope = np.polynomial.polynomial.polyfit(height[sky], seen.luminance[sky], 1)[1]
    return bool(slope > -0.1)


# The horizon ----------------------------------------------------------------------------------------------------------


def find_horizon(pixels: Float[np.ndarray, "height width 3"]) -> Horizon | None:
    """The straight line where the sky meets the sea or a plain; None where there is none to be seen."""
    pixels = _checked(pixels)
    factor = -(-max(pixels.shape[:2]) // WORKING_SIZE)
    light = _light(pixels, factor)
    line = _horizon(_features(_Small(light, np.zeros(light.shape[:2], dtype=bool), None, None, False)))
    if line is None:
        return None
    return Horizon((line.row + 0.5) * factor - 0.5, line.slope, line.confidence)


STEEPEST = 0.25
"""Slope of a horizon, in rows per column, up to which one is looked for."""

STRAIGHT = 1 / 400
"""Widths of the picture by which a column may be off a straight horizon."""

REACH = 4
"""Rows on either side of a step."""


def _horizon(seen: _Features) -> Horizon | None:
    """The line across which brightness, colour and texture step in the same way in most of the columns."""
    height, width = seen.lit.shape
    if height < 8 * REACH or width < 8 * REACH:
        return None
    steps = np.stack([_steps(seen.luminance), _steps(seen.ratio), _steps(np.log(np.maximum(seen.roughness, 0.02))) / 4])
    # Steps are held to be 1 at most, so that a few strong ones do not decide.
    column = np.arange(width)[:: max(1, width // 256)]
    held = np.clip(steps[..., column] / 0.2, -1, 1)
    x = column - (width - 1) / 2
    best, line = 0.0, (0.0, 0.0)
    for slope in np.linspace(-STEEPEST, STEEPEST, 101):
        rows = np.round(np.arange(height)[:, None] + slope * x).astype(int)
        inside = (rows >= 3 * REACH) & (rows <= height - 3 * REACH)
        along = np.where(inside, held[:, np.clip(rows, 0, height - 1), np.arange(column.size)], 0).mean(axis=-1)
        strength = np.linalg.norm(along, axis=0)
        if strength.max() > best:
            best, line = float(strength.max()), (float(strength.argmax()), float(slope))
    return _refined(steps, line) if best > 0.5 else None


def _refined(steps: np.ndarray, line: tuple[float, float]) -> Horizon | None:
    """A line through the strongest step near ``line`` in each column; None if it is seen in less than half of them."""
    height, width = steps.shape[1:]
    column = np.arange(width)
    x = column - (width - 1) / 2
    size = np.linalg.norm(steps, axis=0)
    rows = np.round(line[0] + line[1] * x).astype(int)[None, :] + np.arange(-2 * REACH, 2 * REACH + 1)[:, None]
    inside = (rows >= 3 * REACH) & (rows <= height - 3 * REACH)
    near = np.where(inside, size[np.clip(rows, 0, height - 1), column], 0)
    strong = near.max(axis=0) > 0.15
    y = rows[near.argmax(axis=0), column].astype(float)
    row, slope = line
    for tolerance in (2.0 * REACH, REACH, REACH / 2):
        kept = strong & (np.abs(y - row - slope * x) <= tolerance)
        if kept.sum() < 0.5 * width:
            return None
        row, slope = np.polynomial.polynomial.polyfit(x[kept], y[kept], 1)
    # A step lies between its row and the one above.
    kept = strong & (np.abs(y - row - slope * x) <= STRAIGHT * width)
    return Horizon(float(row) - 0.5, float(slope), float(kept.mean())) if kept.sum() >= 0.5 * width else None


def _steps(image: np.ndarray) -> np.ndarray:
    """Mean of the rows from each on, less that of the rows before it."""
    height = image.shape[0]
    sums = np.cumsum(np.pad(_blurred(image, 1.0), ((1, 0), (0, 0))), axis=0, dtype=np.float64)
    means = (sums[REACH:] - sums[:-REACH]) / REACH
    steps = np.zeros(image.shape, dtype=np.float32)
    steps[REACH : height - REACH + 1] = means[REACH:] - means[:-REACH]
    # A step is sharp: what goes on in the same way above and below is the slope of a smooth sky.
    around = np.pad(steps, ((2 * REACH, 2 * REACH), (0, 0)), mode="edge")
    return steps - (around[: -4 * REACH] + around[4 * REACH :]) / 2


# For people -----------------------------------------------------------------------------------------------------------

TINTS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 0], [0.3, 0.2, 0.1], [0, 0.8, 0.2], [1, 0.2, 0.2], [1, 0.6, 0]])
"""Colours of the labels in a picture."""


def picture(pixels: Float[np.ndarray, "height width 3"], mask: SkyMask) -> Float[np.ndarray, "height width 3"]:
    """Code values in [0, 1] for a screen: clear sky as it is, the rest dimmed and in the colour of its reason."""
    return painted(developed(pixels, mask.sky), mask.label, TINTS)


def developed(
    pixels: Float[np.ndarray, "height width 3"], sky: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """Code values in [0, 1] of linear red, green, blue for a screen, in the exposure of the ``sky``."""
    light = np.maximum(np.nan_to_num(_checked(pixels).astype(np.float64), nan=0.0, posinf=np.inf), 0)
    mean = light.mean(axis=-1)
    shown = np.isfinite(mean) & (mean > 0)
    chosen = mean[shown & sky] if (shown & sky).any() else mean[shown]
    white = np.percentile(chosen, 90) if chosen.size else 1.0
    return ((-np.expm1(-light / white)) ** (1 / 2.2)).astype(np.float32)


def painted(
    codes: Float[np.ndarray, "height width 3"],
    label: UInt8[np.ndarray, "height width"],
    tints: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "height width 3"]:
    """Code values as they are where the label is 0, elsewhere dimmed and in the tint of the label."""
    tinted = 0.5 * codes.mean(axis=-1, keepdims=True) + 0.5 * np.asarray(tints)[label]
    return np.where((label == 0)[..., None], codes, tinted).astype(np.float32)
