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
from diffatmo.features import (
    LOW,
    Features,
    MaskError,
    Small,
    blurred,
    checked,
    dilated,
    factor_of,
    features,
    is_panorama,
    layers,
    light_of,
    reduced,
    wrapped,
)
from diffatmo.horizon import horizon_of

REASONS = ("sky", "not finite", "saturated", "below the horizon", "ground or object", "cloud", "sun and flare")
"""What a pixel shows, by its label."""

SKY, NOT_FINITE, SATURATED, BELOW, OBJECT, CLOUD, SUN = range(len(REASONS))

SUN_RADIUS = np.radians(3.0)
"""Left out around the sun at least."""

GLARE_RADIUS = np.radians(10.0)
"""Within which what looks like cloud is counted as glare of the sun: nothing tells the two apart."""

FLARE_RADIUS = np.radians(25.0)
"""As far as a star or a ghost of the lens is looked for."""


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
    pixels = checked(pixels)
    for name, angle in (("elevation", elevation), ("from_sun", from_sun)):
        if angle is not None and np.shape(angle) != pixels.shape[:2]:
            raise MaskError(f"{name} of shape {np.shape(angle)}, expected that of the picture, {pixels.shape[:2]}")
    finite = np.isfinite(pixels).all(axis=-1)
    clipped = saturated.clipped(pixels, saturation=saturation)
    factor = factor_of(pixels)
    turns = elevation is not None and is_panorama(np.asarray(elevation))
    small = Small(
        pixels=wrapped(light_of(pixels, factor), turns),
        clipped=wrapped(reduced(clipped, factor) > 0, turns),
        elevation=None if elevation is None else wrapped(reduced(elevation, factor), turns),
        from_sun=None if from_sun is None else wrapped(reduced(from_sun, factor), turns),
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


def _label(small: Small) -> tuple[np.ndarray, float]:
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


def _label_upper(small: Small) -> tuple[np.ndarray, float]:
    seen = features(small)
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
    label[dilated(small.clipped, 3) & above] = SATURATED
    return label, cover


# Where there can be sky -----------------------------------------------------------------------------------------------


def _above(small: Small, seen: Features) -> np.ndarray:
    if small.elevation is not None:
        return small.elevation >= 0
    line = horizon_of(seen)
    rows = np.arange(seen.lit.shape[0])[:, None]
    return np.ones(seen.lit.shape, bool) if line is None else rows < line.rows(seen.lit.shape[1])[None, :] - 1


def _height(small: Small, above: np.ndarray) -> np.ndarray:
    """From 0 at the horizon to 1 at the zenith, or from the lowest of what is ``above`` to the top of the picture."""
    if small.elevation is not None:
        return np.sin(np.maximum(small.elevation, 0))
    depth = above.sum(axis=0)
    return np.maximum(1 - (np.arange(above.shape[0])[:, None] + 0.5) / np.maximum(depth, 1), 0)


def _sun(small: Small, seen: Features, above: np.ndarray) -> np.ndarray:
    """The disc of the sun and the star of the lens; without its place, clipped spots that light their surroundings."""
    from skimage import measure

    if small.from_sun is None:
        spots = measure.label(small.clipped & above)
        level = seen.luminance[small.clipped].min() if small.clipped.any() else 0.0
        sun = np.zeros(above.shape, dtype=bool)
        for spot in measure.regionprops(spots):
            if spot.area >= 25:
                inside = spots == spot.label
                around = dilated(inside, 5) & ~dilated(inside, 2) & ~small.clipped & above
                if around.any() and np.median(seen.luminance[around]) > level - 0.5:
                    sun |= dilated(inside, min(np.sqrt(spot.area), 40))
        return sun & above
    sun = small.from_sun < SUN_RADIUS
    if sun.any():
        # What is clipped or rough and hangs together with the disc, unless it stands on the ground.
        rough = above & (small.clipped | (seen.roughness > _threshold(seen, above)))
        pieces = measure.label((rough & (small.from_sun < FLARE_RADIUS)) | sun)
        star = np.isin(pieces, pieces[sun])
        grounded = star & (_height(small, above) < np.sin(np.radians(4)))
        reach = FLARE_RADIUS if not grounded.any() else 2.5 * SUN_RADIUS
        sun |= dilated(star & (small.from_sun < reach), 2)
    return sun


def _threshold(seen: Features, where: np.ndarray) -> float:
    """Roughness that is more than the picture's noise."""
    quiet = np.percentile(seen.roughness[where & seen.lit], 30) if (where & seen.lit).any() else 0.0
    return float(np.clip(3 * quiet, 0.03, 0.12))


# Clear sky and clouds -------------------------------------------------------------------------------------------------


def _clear(small: Small, seen: Features, candidate: np.ndarray, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    redder = redder - layers(redder, small, sky, share=25.0)
    # What is rough and stands clear of the ground is cloud if it is red and bright enough for one.
    rough = candidate & ~sky
    rest = measure.label(dilated(rough, 1) | ground)
    grounded = np.isin(rest, rest[ground])
    free = rough & ~(grounded & (height < 0.4))
    thick = free & ((redder > 0.05) & (brighter > -0.3) | white)
    thick = free & dilated(thick, 5)
    thin = sky & _is_mottled(redder, small, sky, thick)
    return sky & ~thin & ~dilated(rough, 1), thin | thick


def _joined(seen: Features, sky: np.ndarray, regions: list) -> tuple[np.ndarray, np.ndarray]:
    """The sky with the pieces that look like it across the gap, one after the other; and the pieces that are redder: cloud."""
    white = np.zeros_like(sky)
    left = [piece for piece in regions if not sky[tuple(piece.coords[0])]]
    for _ in range(4):
        share = np.maximum(blurred(sky, 5), 1e-6)
        redder, brighter = (
            image - blurred(np.where(sky, image, 0), 5) / share for image in (seen.ratio, seen.luminance)
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


def _is_mottled(redder: np.ndarray, small: Small, sky: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """Where the sky is redder than it should be and varies over one to five degrees, or goes on from there or from ``cloud``.

    Along the horizon of a panorama only what varies from column to column counts, which layers of haze and the belt of
    twilight do not.
    """
    from skimage import measure

    near, far = max(1.0, redder.shape[1] / 600), max(3.0, redder.shape[1] / 100)

    def mean(image: np.ndarray, sigma: float | tuple[float, float]) -> np.ndarray:
        return blurred(np.where(sky, image, 0), sigma) / np.maximum(blurred(sky, sigma), 1e-3)

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
    thin = above & (strength > 0.4 * least) & dilated(seeds, round(2 * far))
    if small.from_sun is None:
        return thin
    # A large cloud is smooth inside. Where the sun is not known, so may be the glow around it.
    inside = measure.label(sky & ((smoothed > 0.2) | seeds))
    return thin | ((inside > 0) & np.isin(inside, inside[seeds | (dilated(cloud, 8) & (inside > 0))]))


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


def _basis(small: Small) -> np.ndarray:
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


def _is_overcast(small: Small, seen: Features, candidate: np.ndarray, above: np.ndarray) -> bool:
    """Whether all of the sky is of one colour, and no brighter at the horizon than higher up."""
    height = _height(small, above)
    sky = candidate & (height > (0.17 if small.elevation is not None else 0.5))
    if small.from_sun is not None:
        sky &= small.from_sun > np.radians(15)
    if sky.sum() < 100:
        return False
    ratio = blurred(seen.ratio, 3)[sky]
    low, middle, high = np.percentile(ratio, [5, 50, 95])
    if high - low > 0.2 or ((np.ptp(height[sky]) < 0.6 or small.elevation is None) and middle < -0.2):
        return False
    slope = np.polynomial.polynomial.polyfit(height[sky], seen.luminance[sky], 1)[1]
    return bool(slope > -0.1)


TINTS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 0], [0.3, 0.2, 0.1], [0, 0.8, 0.2], [1, 0.2, 0.2], [1, 0.6, 0]])
"""Colours of the labels in a picture."""


def picture(pixels: Float[np.ndarray, "height width 3"], mask: SkyMask) -> Float[np.ndarray, "height width 3"]:
    """Code values in [0, 1] for a screen: clear sky as it is, the rest dimmed and in the colour of its reason."""
    return painted(developed(pixels, mask.sky), mask.label, TINTS)


def developed(
    pixels: Float[np.ndarray, "height width 3"], sky: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """Code values in [0, 1] of linear red, green, blue for a screen, in the exposure of the ``sky``."""
    light = np.maximum(np.nan_to_num(checked(pixels).astype(np.float64), nan=0.0, posinf=np.inf), 0)
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
