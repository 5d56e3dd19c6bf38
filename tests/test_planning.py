"""Plans: information adds, exposures only take away, bounds are the error bars of fits, promises are kept."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest
import toy_sky
from toy_sky import FREE, Toy

import fitting
from diffatmo import atmosphere, models
from diffatmo import scene as scenes
from diffatmo.cli.main import main
from diffatmo.render import Scene
from fitting import planning
from fitting.parameters import select
from fitting.planning import (
    Information,
    Photo,
    Sensor,
    SunsDisc,
    combined,
    of_observations,
    of_shots,
    without_nuisances,
)

DEG = math.radians(1)
SMALL = [*FREE[:5], "ground_albedo"]
TIE = dict.fromkeys(("mie_scattering", "ground_albedo"), "start")
SKY = Photo(planning.WHOLE_SKY_BRACKETED, 60 * DEG, bracketed=True)
SHOTS = [
    SKY,
    Photo("across", 60 * DEG, fov=60 * DEG, yaw=90 * DEG, pitch=30 * DEG),
    Photo(planning.WHOLE_SKY, 85 * DEG),
    SunsDisc(planning.DISC, 30 * DEG),
]
EXPOSURES = ("fixed", "free", "free-per-channel")


def parameters(free=SMALL, tie=TIE):
    return select(toy_sky.truth(), free, tie)


@pytest.fixture(scope="module")
def parts():
    """The information of every shot, by exposure."""
    shots = [replace(shot, exposure=exposure) for exposure in (*EXPOSURES, "camera") for shot in SHOTS]
    found = of_shots(shots, parameters(), Toy(), sensor=Sensor(), altitude=0.1)
    return {name: found[len(SHOTS) * n : len(SHOTS) * (n + 1)] for n, name in enumerate((*EXPOSURES, "camera"))}


def fisher(factor):
    return factor.T @ factor


def close(a, b, tolerance=1e-5):
    """Relative to the size of the numbers on either side of the diagonal."""
    scale = np.sqrt(np.outer(np.diag(b), np.diag(b)))
    np.testing.assert_allclose(a / scale, b / scale, atol=tolerance)


def test_information_adds(parts):
    first, second = parts["fixed"][:2]
    both = combined([first, second])
    assert both.nuisances == ()
    # The sum is made by an orthogonal transformation in double precision.
    close(fisher(both.factor), fisher(first.factor) + fisher(second.factor), 1e-12)


def test_exposures_are_eliminated_exactly():
    random = np.random.default_rng(0)
    one = Information(("a", "b"), random.standard_normal((30, 5)))
    two = Information(("b",), random.standard_normal((20, 4)))
    joint = np.zeros((50, 5))
    joint[:30], joint[30:, 1:] = one.factor, two.factor
    together = np.linalg.inv(fisher(joint))[2:, 2:]
    np.testing.assert_allclose(fisher(without_nuisances(combined([one, two]))), np.linalg.inv(together), rtol=1e-10)
    # Sharing a factor with others determines it better than having one of one's own.
    apart = combined([one, Information(("c",), two.factor)])
    gained = fisher(without_nuisances(combined([one, two]))) - fisher(without_nuisances(apart))
    assert np.linalg.eigvalsh(gained).min() > -1e-10


def test_an_exposure_that_nothing_depends_on_takes_nothing_away():
    factor = np.random.default_rng(0).standard_normal((9, 4))
    factor[:, 0] = 0
    np.testing.assert_allclose(fisher(without_nuisances(Information(("dark",), factor))), fisher(factor[:, 1:]))


def test_an_unknown_exposure_never_helps(parts):
    for known, *others in zip(*(parts[exposure] for exposure in (*EXPOSURES, "camera")), strict=True):
        full, free, channels, shared = (fisher(without_nuisances(part)) for part in (known, *others))
        # The disc tells nothing of some coordinates.
        size = np.maximum(np.sqrt(np.diag(full)), 1e-6)
        for more, less in pairwise((full, free, channels)):
            # To the rounding of factors computed in single precision.
            assert np.linalg.eigvalsh((more - less) / np.outer(size, size)).min() > -1e-5
        # An exposure that no other image shares is a free one.
        np.testing.assert_allclose(shared, free)


def test_information_grows_with_pixels_and_falls_with_noise(parts):
    for sensor, factor in ((Sensor(noise=0.02), 0.25), (Sensor(pixels=4 * 4096.0), 4.0)):
        other = of_shots(SHOTS[:3], parameters(), Toy(), sensor=sensor, altitude=0.1)
        for part, scaled in zip(parts["fixed"], other, strict=False):
            close(fisher(scaled.factor), factor * fisher(part.factor))
    half = of_shots(SHOTS[3:], parameters(), Toy(), sensor=Sensor(disc_noise=0.005), altitude=0.1)[0]
    np.testing.assert_allclose(half.factor, 2 * parts["fixed"][3].factor)


def test_a_single_exposure_tells_less_than_a_bracketed_one():
    photos = [replace(SKY, bracketed=bracketed) for bracketed in (True, False)]
    more, less = (fisher(part.factor) for part in of_shots(photos, parameters(), Toy(), sensor=Sensor(), altitude=0.1))
    size = np.sqrt(np.diag(more))
    assert np.linalg.eigvalsh((more - less) / np.outer(size, size)).min() > -1e-5
    assert np.trace((more - less) / np.outer(size, size)) > 0.1


def shoot(photo, name, noise=0.01, seed=None, size=64):
    """The photo taken, in the toy's truth."""
    camera = photo.camera(size)
    light = np.asarray(toy_sky._image(toy_sky.truth(), photo.towards_sun, camera.directions()), float)
    if seed is not None:
        light = light * (1 + noise * np.random.default_rng(seed).standard_normal(light.shape))
    return fitting.observe(
        light, camera=camera, altitude=0.1, sun=photo.towards_sun, noise=noise, exposure=photo.exposure, name=name
    )


@pytest.mark.parametrize("exposure", ["fixed", "camera-per-channel"])
def test_bounds_are_the_error_bars_of_a_fit(exposure):
    """Without noise in the pixels the fit ends at the truth, with residuals of zero, which do not widen its error bars."""
    images = toy_sky.observations(
        noise=0.0, exposure=(exposure,) * 3, factors=(2.0, 2.0, 2.0) if exposure != "fixed" else (1,) * 3
    )
    result = fitting.fit(images, init=toy_sky.truth(), free=SMALL, tie=TIE, model=Toy(), refine=False)
    found = planning.plan(
        images, atmosphere=toy_sky.truth(), free=SMALL, tie=TIE, model=Toy(), shots=SHOTS[3:], count=0
    )
    expected = [e.standard_error for e in result.parameters]
    assert [quantity.name for quantity in found.quantities] == [e.name for e in result.parameters]
    np.testing.assert_allclose(found.standard_errors, expected, rtol=2e-3)


def test_a_shot_tells_what_the_photo_will():
    """The frame that a plan weighs is coarser than the photo; the sky between its pixels is smooth, but for the aureole."""
    photo = replace(SKY, fov=60 * DEG, yaw=90 * DEG, pitch=40 * DEG, exposure="free")
    image = shoot(photo, "taken")
    taken = of_observations([image], parameters(), Toy())
    planned = of_shots([photo], parameters(), Toy(), sensor=Sensor.like([image]), altitude=0.1)[0]
    close(fisher(without_nuisances(planned)), fisher(without_nuisances(taken)), 0.03)


def test_the_disc_tells_the_optical_depth():
    """With the sun overhead, d ln T / d ln τ = -τ, cut at the top of the atmosphere, of each channel by itself."""
    free = parameters(["rayleigh_scattering"], {})
    shots = [SunsDisc(planning.DISC, 0.0, exposure) for exposure in EXPOSURES]
    known, free_factor, per_channel = (
        without_nuisances(part) for part in of_shots(shots, free, Toy(), sensor=Sensor(disc_noise=0.02), altitude=0.0)
    )
    depth = np.asarray(toy_sky.truth().rayleigh_optical_depth) * (1 - math.exp(-100 / 8))
    np.testing.assert_allclose(fisher(known), np.diag((depth / 0.02) ** 2), rtol=1e-4, atol=1e-6)
    # One factor for all: what is common to the channels is lost.
    left = np.diag(depth) @ (np.eye(3) - 1 / 3) @ np.diag(depth) / 0.02**2
    np.testing.assert_allclose(fisher(free_factor), left, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(per_channel, 0, atol=1e-6)


def test_a_dark_channel_of_the_sun_tells_nothing():
    dark = toy_sky.change(toy_sky.truth(), solar_irradiance=np.array([1.0, 0.0, 1.0]))
    part = of_shots(SHOTS[3:], select(dark, SMALL, TIE), Toy(), sensor=Sensor(), altitude=0.1)[0]
    assert np.isfinite(part.factor).all()
    assert not part.factor[1].any()


def test_a_shot_that_sees_nothing_buys_nothing():
    images = toy_sky.observations(zeniths=(40.0,))
    blind = Sensor(brightest=0.0)
    shots = [replace(SHOTS[1], exposure=exposure) for exposure in EXPOSURES]
    found = planning.plan(
        images, atmosphere=toy_sky.truth(), free=SMALL, tie=TIE, shots=shots, sensor=blind, model=Toy()
    )
    for prospect in found.ranking:
        assert prospect.gain == pytest.approx(1, abs=1e-9)
        assert prospect.standard_errors == pytest.approx(found.standard_errors)
    ground = Photo("the ground", 60 * DEG, fov=20 * DEG, pitch=-60 * DEG)
    with pytest.raises(fitting.FitError, match="the ground, sun at 60°: no pixel is left"):
        of_shots([ground], parameters(), Toy(), sensor=Sensor(), altitude=0.1)


def test_without_images_nothing_is_determined_and_gains_are_finite():
    found = planning.plan([], atmosphere=toy_sky.truth(), free=SMALL, tie=TIE, shots=SHOTS, model=Toy())
    assert set(found.standard_errors) == {None}
    assert all(math.isfinite(prospect.gain) and prospect.gain > 1 for prospect in found.ranking)
    # Three numbers of the disc cannot tell eight coordinates, but do tell something.
    disc = next(prospect for prospect in found.ranking if isinstance(prospect.shot, SunsDisc))
    assert None in disc.standard_errors
    assert None not in found.ranking[0].standard_errors


def test_what_no_shot_can_tell_stays_undetermined():
    """The light of the sun and an unknown exposure are one number."""
    free = [*SMALL, "solar_irradiance"]
    tie = TIE | {"solar_irradiance": "start"}
    shots = [replace(SKY, exposure="free"), SKY]
    found = planning.plan([], atmosphere=toy_sky.truth(), free=free, tie=tie, shots=shots, model=Toy(), count=1)
    names = [quantity.field for quantity in found.quantities]
    errors = {p.shot.exposure: dict(zip(names, p.standard_errors, strict=True)) for p in found.ranking}
    gains = {p.shot.exposure: p.gains["solar_irradiance"] for p in found.ranking}
    assert errors["free"]["solar_irradiance"] is None
    assert errors["free"]["mie_g"] is not None
    assert gains["free"] == pytest.approx(1, abs=1e-3)
    assert errors["fixed"]["solar_irradiance"] is not None


def test_what_is_known_beforehand_counts_as_another_measurement():
    """Precisions add: of one number exactly."""
    prior = fitting.Prior("mie_g", 0.8, 1e-3)
    wanted = {"atmosphere": toy_sky.truth(), "free": ["mie_g"], "shots": SHOTS[:1], "count": 1, "model": Toy()}
    alone, known = planning.plan([], **wanted), planning.plan([], priors=[prior], **wanted)
    assert alone.standard_errors == [None]
    assert known.standard_errors == [pytest.approx(1e-3, rel=1e-5)]
    (shot,), (both,) = alone.sequence[0].standard_errors, known.sequence[0].standard_errors
    assert 1 / both**2 == pytest.approx(1 / shot**2 + 1e6, rel=1e-4)


def test_ranking_and_sequence():
    images = toy_sky.observations(zeniths=(40.0,), exposure=("camera",))
    shots = [replace(shot, exposure="camera") for shot in SHOTS]
    aims = ["mie_g", "rayleigh_optical_depth"]
    found = planning.plan(
        images,
        atmosphere=toy_sky.truth(),
        free=SMALL,
        tie=TIE,
        shots=shots,
        ranked_only=SHOTS,
        aims=aims,
        count=9,
        model=Toy(),
    )
    gains = [prospect.gain for prospect in found.ranking]
    assert gains == sorted(gains, reverse=True)
    assert len(gains) == 2 * len(SHOTS)
    for prospect in found.ranking:
        assert list(prospect.gains) == aims
        assert prospect.gain == pytest.approx(math.sqrt(math.prod(prospect.gains.values())))
    # Each shot once, those with the other exposure never, the best first.
    assert sorted(p.shot.name for p in found.sequence) == sorted(shot.name for shot in SHOTS)
    assert {p.shot.exposure for p in found.sequence} == {"camera"}
    best = next(p for p in found.ranking if p.shot.exposure == "camera")
    assert found.sequence[0].shot == best.shot
    assert found.sequence[0].gain == best.gain
    # What is known well was not vague: there gains are ratios of error bars, and those of a sequence multiply.
    names = [quantity.name for quantity in found.quantities]
    before, after = (
        errors[names.index("mie_g")] for errors in (found.standard_errors, found.sequence[-1].standard_errors)
    )
    assert math.prod(p.gains["mie_g"] for p in found.sequence) == pytest.approx(before / after, rel=1e-4)


def test_aims():
    own = parameters()
    question, named, values = planning.ask(own, ["mie_optical_depth_550", "ground_albedo", "rayleigh_scattering_440"])
    counts = [int(chosen.sum()) for chosen in question.members.values()]
    # A field counts with all its numbers, one of its numbers alone.
    assert counts == [1, 3, 1]
    assert values[[q.name for q in named].index("mie_g")] == pytest.approx(0.8)
    with pytest.raises(fitting.FitError, match=r"for: 'mie_gg' is not free .* did you mean 'mie_g'\?"):
        planning.ask(own, ["mie_gg"])
    with pytest.raises(fitting.FitError, match="'mie_absorption' is not free"):
        planning.ask(own, ["mie_absorption"])
    with pytest.raises(fitting.FitError, match="no parameter"):
        planning.plan([], atmosphere=toy_sky.truth(), free=SMALL, aims=[], model=Toy())


def test_a_sensor_like_that_of_the_images():
    sensor = Sensor.like(toy_sky.observations(noise=0.02, zeniths=(30.0, 60.0)))
    assert sensor.noise == pytest.approx(0.02, rel=1e-3)
    assert sensor.pixels == 16 * 64
    assert Sensor.like([]) == Sensor()


def test_candidates_are_all_different_and_point_where_they_say():
    shots = planning.candidates(exposures=EXPOSURES)
    assert len({(shot.name, shot.exposure) for shot in shots}) == len(shots)
    assert max(shot.sun_zenith for shot in shots if isinstance(shot, SunsDisc)) <= planning.LOWEST_DISC
    for shot in shots:
        if isinstance(shot, Photo) and shot.fov < math.pi:
            middle = np.asarray(shot.camera(9).directions())[4, 4]
            if "around the sun" in shot.kind:
                assert middle @ shot.towards_sun == pytest.approx(1, abs=1e-5)
            if "away from" in shot.kind:
                assert middle @ np.array([0, 1, 0]) < 0


def test_the_first_advice_delivers_what_it_promises():
    """Two fits to photos with noise: the error bars they report shrink by the gain promised, and their pulls are of size one.

    The promise was made at the truth; the noise moves the point of the linearisation, and with it an error bar, by about as
    much as that is relative to the number: some percent.
    """
    first = [replace(SKY, exposure="free", fov=math.pi, sun_zenith=zenith * DEG) for zenith in (40.0, 70.0)]
    shots = [
        shot for shot in planning.candidates(suns=[60 * DEG, 85 * DEG], exposures=["free"]) if isinstance(shot, Photo)
    ]
    shots = [replace(shot, bracketed=True) for shot in shots if "overhead" not in shot.kind]
    taken = [shoot(photo, f"photo {number}", seed=number) for number, photo in enumerate(first)]
    settings = {"free": SMALL, "tie": TIE, "model": Toy()}
    found = planning.plan(taken, atmosphere=toy_sky.truth(), shots=shots, count=1, **settings)
    assert found.aims == tuple(SMALL)
    best = found.ranking[0]
    delivered, pulls = [], []
    for seed in range(2):
        photos = [shoot(p, f"photo {n}", seed=10 * seed + n) for n, p in enumerate([*first, best.shot])]
        results = [
            fitting.fit(images, init=toy_sky.truth(), **settings).with_truth(toy_sky.truth())
            for images in (photos[:2], photos)
        ]
        logs = []
        for aim in SMALL:
            errors = [[e.standard_error for e in result.parameters if e.field == aim] for result in results]
            logs.append(np.mean(np.log(np.array(errors[0]) / np.array(errors[1]))))
        delivered.append(math.exp(np.mean(logs)))
        pulls += [e.pull for e in results[1].parameters if not e.derived]
    assert np.mean(delivered) == pytest.approx(best.gain, rel=0.1)
    assert best.gain > 1.5
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.8


# The command --------------------------------------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A scene file with one photo, whose exposure is free."""
    monkeypatch.setitem(models.MODELS, "moments", Toy)
    atmosphere.save(toy_sky.truth(), tmp_path / "air.toml")
    place = Scene(toy_sky.truth(), toy_sky.CAMERA, 0.1, toy_sky.towards_sun(40.0))
    scenes.save(tmp_path / "sky.exr", toy_sky.image(toy_sky.truth(), 40.0), place)
    quoted = ", ".join(f'"{name}"' for name in SMALL)
    ties = ", ".join(f'{name} = "{kind}"' for name, kind in TIE.items())
    head = f'init = "air.toml"\nfree = [{quoted}]\ntie = {{ {ties} }}\n'
    (tmp_path / "empty.toml").write_text(head)
    (tmp_path / "scene.toml").write_text(head + '[[image]]\nfile = "sky.exr"\nexposure = "free"\n')
    return tmp_path


def read(folder):
    def refuse(constant):
        raise ValueError(constant)

    return json.loads((folder / "plan.json").read_text(), parse_constant=refuse)


def test_plan_writes_table_picture_and_page(scene, capsys):
    arguments = ["plan", str(scene / "scene.toml"), "-o", str(scene / "next"), "--suns", "60", "--shots", "2"]
    arguments += ["--for", "mie_g,mie_optical_depth_550"]
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "exposure unknown" in shown
    assert "The bounds know the noise alone" in " ".join(shown.split())
    record = read(scene / "next")
    assert record["for"] == ["mie_g", "mie_optical_depth_550"]
    assert {entry["exposure"] for entry in record["ranking"]} == {"fixed", "free"}
    assert len(record["sequence"]) == 2
    best = next(entry for entry in record["ranking"] if entry["exposure"] == "free")
    assert record["sequence"][0] == best
    assert best["gain"] > 1
    assert 0 < best["standard_errors"]["mie_g"] < record["now"]["mie_g"]["standard_error"]
    page = (scene / "next" / "plan.html").read_text()
    assert "data:image/png;base64," in page
    assert page.count("<tr>") == 1 + 2 + 1 + len(record["ranking"]) // 2
    assert (scene / "next" / "plan.png").read_bytes().startswith(b"\x89PNG")
    assert main(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_plan_of_a_first_photo(scene, capsys):
    options = [
        "--suns",
        "60",
        "--atmosphere",
        str(scene / "air.toml"),
        "--noise",
        "0.02",
        "--exposure",
        "free-per-channel",
    ]
    assert main(["plan", str(scene / "empty.toml"), "-o", str(scene / "next"), *options]) == 0
    record = read(scene / "next")
    assert {entry["standard_error"] for entry in record["now"].values()} == {None}
    assert record["sensor"]["noise"] == 0.02
    assert record["exposure"] == "free-per-channel"
    assert "not determined" in capsys.readouterr().out
    # For a fit, a scene without images is a mistake.
    assert main(["fit", "--config", str(scene / "empty.toml"), "-o", str(scene / "fit")]) == 2
    assert "at least 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--for", "mie_gg"], "did you mean 'mie_g'"),
        (["--suns", "60,noon"], "--suns: got 'noon', expected a number from 0 to 108"),
        (["--suns", "120"], "--suns: got 120.0"),
        (["--noise", "0"], "--noise: got 0.0"),
        (["--altitude-km", "-1"], "--altitude-km: got -1.0"),
        (["--exposure", "fixed-per-channel"], "--exposure: got 'fixed-per-channel'"),
        (["--atmosphere", "nowhere.toml"], "nowhere.toml: no such file"),
    ],
)
def test_plan_refuses_in_one_line(scene, capsys, options, message):
    assert main(["plan", str(scene / "scene.toml"), "-o", str(scene / "next"), *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list((scene / "next").glob("plan*"))


def test_plan_refuses_other_wavelengths(scene, capsys):
    other = atmosphere.earth(np.array([650.0, 550.0, 450.0]))
    atmosphere.save(other, scene / "other.toml")
    arguments = [
        "plan",
        str(scene / "scene.toml"),
        "-o",
        str(scene / "next"),
        "--atmosphere",
        str(scene / "other.toml"),
    ]
    assert main(arguments) == 2
    assert "has wavelengths" in capsys.readouterr().err


def test_a_model_that_is_not_finite_is_refused():
    class Broken(Toy):
        def sky(self, atmosphere):
            return toy_sky.ToySky(jax.tree.map(lambda x: x * np.nan, atmosphere))

    with pytest.raises(
        fitting.FitError, match="across, sun at 60°: the model's radiance in the atmosphere given: not finite in"
    ):
        of_shots([SHOTS[1]], parameters(), Broken(), sensor=Sensor(), altitude=0.1)
