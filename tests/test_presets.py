"""Presets of other renderers: what they hold comes back to the last digit, what they do not is told in numbers."""

import dataclasses
import re
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffatmo
from diffatmo import atmosphere, phase, presets
from diffatmo.cli.main import main
from diffatmo.models import RayMarch
from diffatmo.presets import PresetError

CORNETTE_SHANKS = ("three-geospatial", "bruneton")
BLENDER = ("blender", "blender-nishita")


def odd(**changes):
    """An atmosphere whose every number needs all the digits of its precision."""
    third = jnp.asarray([1.0, 1.1, 1.3]) / 3
    air = diffatmo.earth()
    return dataclasses.replace(
        air,
        bottom_radius=6371.0088,
        top_radius=6471.0088,
        rayleigh_scattering=air.rayleigh_scattering * third,
        rayleigh_scale_height=25 / 3,
        mie_scattering=air.mie_scattering * third,
        mie_absorption=air.mie_absorption / third,
        mie_scale_height=4 / 3,
        mie_g=2 / 3,
        ozone_absorption=air.ozone_absorption * third,
        ozone_center_altitude=70 / 3,
        ozone_half_width=50 / 3,
        **changes,
    )


def held(target):
    """An atmosphere that ``target`` can hold."""
    if target == "unreal":
        return odd(ground_albedo=diffatmo.color.srgb_decode(jnp.array([170, 99, 1]) / 255))
    if target in CORNETTE_SHANKS:
        return odd(mie_phase="cornette-shanks", solar_irradiance=[1.474, 1.8504, 1.91198])
    return presets.read(presets.write(diffatmo.earth(), target))


def assert_same(a, b, **tolerances):
    assert a.mie_phase == b.mie_phase
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(one, other, **tolerances or {"rtol": 0, "atol": 0})


@pytest.mark.parametrize("target", presets.TARGETS)
def test_what_is_held_comes_back_to_the_bit(target):
    air = held(target)
    text = presets.write(air, target, remarks=["a remark: 1 -> 2"])
    again = presets.read(text)
    # The multiples of Blender's air have six digits.
    assert_same(again, air, **({"rtol": 1e-6} if target in BLENDER else {}))
    assert "a remark" in text
    assert presets.write(again, target, remarks=["a remark: 1 -> 2"]) == text


@pytest.mark.parametrize("target", ["unreal", *CORNETTE_SHANKS])
def test_double_precision_comes_back_to_the_last_digit(target, x64):
    """Quotients, like 1 / scale height, are rounded once on either way."""
    air = held(target)
    assert air.bottom_radius.dtype == jnp.float64
    assert_same(presets.read(presets.write(air, target)), air, rtol=5e-16)


@pytest.mark.parametrize("target", ["unreal", *CORNETTE_SHANKS])
def test_nothing_is_lost_of_what_is_held(target):
    assert presets.losses(held(target), target) == []
    assert [(sky.rms, sky.largest) for sky in presets.sky_losses(held(target), target)] == [(0, 0)] * 3


def test_wavelengths_in_any_order_are_channels_from_red_to_blue():
    air = held("three-geospatial")
    spectra = {name: getattr(air, name)[::-1] for name in atmosphere.SPECTRAL}
    assert presets.write(dataclasses.replace(air, **spectra), "three-geospatial") == presets.write(
        air, "three-geospatial"
    )


def test_defaults_of_unreal():
    """A component that says nothing is USkyAtmosphereComponent as it is constructed."""
    air = presets.read('Begin Object Name="SkyAtmosphereComponent"\nEnd Object\n')
    assert (air.bottom_radius, air.top_radius) == (6360, 6420)
    np.testing.assert_allclose(air.rayleigh_scattering, [5.802e-3, 13.558e-3, 33.1e-3], rtol=1e-6)
    np.testing.assert_allclose(air.mie_extinction, np.full(3, 4.44e-3), rtol=1e-6)
    np.testing.assert_allclose(air.ozone_absorption, [0.650e-3, 1.881e-3, 0.085e-3], rtol=1e-6)
    # "170 => 0.4f linear", says its source.
    np.testing.assert_allclose(air.ground_albedo, np.full(3, 0.4), atol=0.003)


def test_a_component_copied_in_unreal():
    """As the editor writes it: what differs from the default, members too, among other actors."""
    text = """Begin Map
   Begin Level
      Begin Actor Class=/Script/Engine.DirectionalLight Name=Sun
         Begin Object Class=/Script/Engine.DirectionalLightComponent Name="LightComponent0"
            MieAnisotropy=0.1
         End Object
      End Actor
      Begin Actor Class=/Script/Engine.SkyAtmosphere Name=Sky Archetype="/Script/Engine.Default__SkyAtmosphere"
         Begin Object Class=/Script/Engine.SkyAtmosphereComponent Name="SkyAtmosphereComponent"
         End Object
         Begin Object Name="SkyAtmosphereComponent" ExportPath="/Script/Engine.SkyAtmosphereComponent'/Temp/Untitled'"
            GroundAlbedo=(B=10,G=20,R=255,A=255)
            MieAnisotropy=0.750000
            OtherTentDistribution=(TipAltitude=30.000000,TipValue=0.500000)
            RelativeLocation=(X=1.0,Y=2.0,Z=3.0)
         End Object
      End Actor
   End Level
End Map
"""
    air = presets.read(text)
    assert float(air.mie_g) == 0.75
    assert float(air.ground_albedo[0]) == 1
    assert float(air.ground_albedo[1]) > float(air.ground_albedo[2])
    assert (float(air.ozone_center_altitude), float(air.ozone_half_width)) == (30, 15)
    np.testing.assert_allclose(air.ozone_absorption[1], 1.881e-3 / 2, rtol=1e-6)


def test_units_of_three_geospatial_and_of_bruneton():
    """Radii in metres and coefficients in 1/km; everything in metres. The numbers are those of their own defaults."""
    air = dataclasses.replace(diffatmo.earth(), mie_phase="cornette-shanks", top_radius=6420.0)
    text = presets.write(air, "three-geospatial")
    for line in (
        "bottomRadius: 6360000.0,",
        "topRadius: 6420000.0,",
        "rayleighScattering: new Vector3(0.005802, 0.013558, 0.0331),",
        "mieExtinction: new Vector3(0.00444, 0.00444, 0.00444),",
        "new DensityProfileLayer(0.0, 1.0, -0.125, 0.0, 0.0)",
        f"new DensityProfileLayer(25.0, 0.0, 0.0, {1 / 15}, {1 - 25 / 15})",
    ):
        assert line in text, line
    text = presets.write(air, "bruneton")
    for line in (
        "kWavelengths = {440.0, 550.0, 680.0};",
        "kBottomRadius = 6360000.0;",
        "kRayleighScattering = {3.31e-05, 1.3558e-05, 5.802e-06};",
        "DensityProfileLayer(0.0, 1.0, -0.000125, 0.0, 0.0)",
    ):
        assert line in text, line


@pytest.mark.parametrize("target", BLENDER)
def test_blender_at_density_one(target):
    """Against coefficients of Blender's source, 1/km: at bands of its own, and the table of the old model."""
    text = presets.write(diffatmo.earth(), target)
    text = re.sub(r"(_density = )[\d.e-]+", r"\g<1>1.0", text)
    if target == "blender":
        air = presets.read(text, wavelengths=[630, 560, 490, 430])
        np.testing.assert_allclose(air.rayleigh_scattering, [6.605e-3, 1.067e-2, 1.842e-2, 3.156e-2], rtol=1e-6)
        # 1.3681e20 /m³ of 1.5908e-22 … 2.4033e-22 m², in the units of its source.
        np.testing.assert_allclose(air.mie_scattering, [0.021764, 0.024230, 0.028651, 0.032880], rtol=2e-5)
        # ∫ exp(-0.0777 h^1.164) dh and the column, mean and variance of the layer of ozone, integrated.
        h = np.linspace(1e-3, 300, 300_000)
        layer = np.exp(-5.55555555 * (np.log(h) - 3.22261) ** 2) / h
        column, mean = np.trapezoid(layer, h), np.trapezoid(layer * h, h) / np.trapezoid(layer, h)
        variance = np.trapezoid(layer * (h - mean) ** 2, h) / column
        np.testing.assert_allclose(
            air.rayleigh_scale_height, np.trapezoid(np.exp(-0.07771971 * h**1.16364243), h), rtol=2e-4
        )
        np.testing.assert_allclose(air.ozone_center_altitude, mean, rtol=1e-3)
        np.testing.assert_allclose(air.ozone_half_width**2 / 6, variance, rtol=2e-3)
        absorbed = 334.5 * 3.78547397e20 * column * np.array([3.472e-25, 3.914e-25])
        found = air.ozone_absorption * air.ozone_half_width
        np.testing.assert_allclose(found[:2], absorbed, rtol=0.02)
    else:
        air = presets.read(text, wavelengths=[680, 600, 560, 500, 440])
        np.testing.assert_allclose(
            air.rayleigh_scattering, [5.2903e-3, 8.7280e-3, 1.15018e-2, 1.80984e-2, 3.01793e-2], rtol=2e-4
        )
        np.testing.assert_allclose(air.ozone_absorption[1:4], [2.7355e-3, 2.0904e-3, 6.3551e-4], rtol=0.05)
        np.testing.assert_allclose(air.mie_absorption, 0.11 * air.mie_scattering, rtol=1e-6)
    assert phase.mie_moments(air.mie_g, 0, air.mie_phase)[0] == 1


@pytest.mark.parametrize("target", BLENDER)
def test_blender_s_densities_are_amounts(target):
    def densities(air):
        text = presets.write(air, target)
        found = dict(re.findall(r"(\w+_density) = (\S+)", text))
        return [float(found[key]) for key in ("air_density", "aerosol_density", "ozone_density")]

    air = held(target)
    more = dataclasses.replace(
        air,
        rayleigh_scattering=2 * air.rayleigh_scattering,
        mie_scattering=3 * air.mie_scattering,
        mie_absorption=3 * air.mie_absorption,
        # The same amount in twice the height counts twice.
        ozone_half_width=2 * air.ozone_half_width,
    )
    np.testing.assert_allclose(np.divide(densities(more), densities(air)), [2, 3, 2], rtol=1e-5)
    huge = dataclasses.replace(air, mie_scattering=1e9 * air.mie_scattering)
    assert densities(huge)[1] == {"blender": 1000, "blender-nishita": 10}[target]


class Nodes(list):
    """What Blender's collection of nodes does here."""

    def new(self, kind):
        sockets = {name: f"{kind}.{name}" for name in ("Color", "Background", "Surface")}
        self.append(SimpleNamespace(bl_idname=kind, inputs=sockets, outputs=sockets))
        return self[-1]


@pytest.mark.parametrize(("target", "old"), [("blender", False), ("blender-nishita", False), ("blender-nishita", True)])
def test_blender_s_script_runs(target, old, monkeypatch):
    """With a stand-in for Blender: it sets the texture that is there, and wires up what is not."""
    nodes, links = Nodes(), []
    sky = nodes.new("ShaderNodeTexSky")
    if old:
        sky.dust_density = 1.0
    tree = SimpleNamespace(nodes=nodes, links=SimpleNamespace(new=lambda *ends: links.append(ends)))
    scene = SimpleNamespace(world=SimpleNamespace(node_tree=tree))
    monkeypatch.setitem(sys.modules, "bpy", SimpleNamespace(context=SimpleNamespace(scene=scene)))
    exec(presets.write(diffatmo.earth(), target), {})
    expected = {"blender": "MULTIPLE_SCATTERING", "blender-nishita": "NISHITA" if old else "SINGLE_SCATTERING"}
    assert sky.sky_type == expected[target]
    assert (sky.dust_density if old else sky.aerosol_density) != 1
    assert len(links) == 2
    assert len(nodes) == 3


@pytest.mark.parametrize("g", [-0.9, -0.3, 0.0, 0.5, 0.95])
@pytest.mark.parametrize(("name", "target"), [("henyey-greenstein", "bruneton"), ("cornette-shanks", "unreal")])
def test_another_phase_function_keeps_the_mean_cosine(g, name, target):
    air = dataclasses.replace(diffatmo.earth(), mie_phase=name, mie_g=g)
    back = presets.read(presets.write(air, target))
    wanted, found = (phase.mie_moments(a.mie_g, 1, a.mie_phase)[1] for a in (air, back))
    # Unreal has no backward scattering, and no g beyond 0.999.
    np.testing.assert_allclose(found, max(wanted, 0) if target == "unreal" else wanted, atol=2e-5)


def test_losses_are_named_with_their_numbers():
    table = phase.PhaseTable((0.0, 90.0, 180.0), (3.0, 1.0, 1.0))
    air = dataclasses.replace(
        diffatmo.earth(), mie_phase=table, solar_irradiance=[1.4, 1.8, 1.9], ground_albedo=[0.3, 0.0, 1.0]
    )
    lost = {loss.key: loss for loss in presets.losses(air, "unreal")}
    assert set(lost) == {"mie_phase", "mie_g", "solar_irradiance", "ground_albedo"}
    assert lost["mie_phase"][1:3] == ("a table", "henyey-greenstein")
    np.testing.assert_allclose(lost["mie_g"].held, table.asymmetry, rtol=1e-6)
    assert lost["solar_irradiance"].held == (1, 1, 1)
    # (149 / 255 + 0.055)^2.4 / 1.055^2.4
    np.testing.assert_allclose(lost["ground_albedo"].held, [0.300544, 0, 1], atol=1e-6)
    assert str(lost["ground_albedo"]) == "ground_albedo: 0.3, 0, 1 -> 0.300544, 0, 1 (8 bits in sRGB)"
    assert {loss.key for loss in presets.losses(air, "three-geospatial")} == {"mie_phase", "mie_g"}


def test_other_wavelengths_are_interpolated_for_channels_and_kept_by_bruneton():
    air = diffatmo.earth([450.0, 550.0, 650.0, 750.0])
    first = presets.losses(air, "three-geospatial")[0]
    assert first[:3] == ("wavelengths_nm", (750, 650, 550, 450), (680, 550, 440))
    back = presets.read(presets.write(air, "three-geospatial"))
    # 550 is one of them, 440 is beyond, 680 between.
    blue, green, red, infrared = air.rayleigh_scattering
    np.testing.assert_allclose(back.rayleigh_scattering, [0.7 * red + 0.3 * infrared, green, blue], rtol=1e-6)
    back = presets.read(presets.write(air, "bruneton"))
    np.testing.assert_array_equal(back.wavelengths, air.wavelengths[::-1])
    np.testing.assert_array_equal(back.ozone_absorption, air.ozone_absorption[::-1])


def test_channels_are_of_the_wavelengths_that_are_asked_for():
    text = presets.write(diffatmo.earth(), "unreal")
    np.testing.assert_array_equal(presets.read(text, wavelengths=[640, 540, 460]).wavelengths, [640, 540, 460])
    with pytest.raises(PresetError, match="wavelengths: got 2, expected three"):
        presets.read(text, wavelengths=[640, 540])
    with pytest.raises(PresetError, match="says its own"):
        presets.read(presets.write(diffatmo.earth(), "bruneton"), wavelengths=[640, 540, 460])


def test_the_sky_of_thin_air_is_as_its_scattering():
    """Where light is scattered once and never dimmed, a channel is off by what its coefficient is off by, in any direction."""
    target = "blender-nishita"
    air = presets.read(presets.write(diffatmo.earth(), target))
    nothing = jnp.zeros(3)
    thin = dataclasses.replace(
        air,
        rayleigh_scattering=1e-6 * air.rayleigh_scattering * jnp.array([1.0, 1.2, 0.9]),
        mie_scattering=nothing,
        mie_absorption=nothing,
        ozone_absorption=nothing,
    )
    off = next(loss for loss in presets.losses(thin, target) if loss.key == "rayleigh_scattering_per_km")
    expected = np.divide(off.held, off.given) - 1
    for sky in presets.sky_losses(thin, target, model=RayMarch()):
        np.testing.assert_allclose(sky.rms, np.sqrt(np.mean(expected**2)), rtol=2e-3)
        np.testing.assert_allclose(sky.largest, expected[1], rtol=2e-3)


def test_the_command_says_what_is_lost(monkeypatch, tmp_path, capsys):
    found = [presets.SkyLoss(zenith, 0.01, -0.123) for zenith in presets.SUN_ZENITHS_DEG]
    monkeypatch.setattr(presets, "sky_losses", lambda *_: found)
    out = tmp_path / "sky.t3d"
    assert main(["export", "earth", "--preset", "unreal", "-o", str(out)]) == 0
    printed, text = capsys.readouterr().out, out.read_text()
    assert text.startswith("Begin Map\n// ")
    for line in ("sky, sun 85 degrees from the zenith: 1 % RMS, -12 % at most", "Not counted: light"):
        assert line in printed
        assert f"// {line}" in text
    assert "ground_albedo" in printed
    assert "// ground_albedo: 0.3, 0.3, 0.3 -> 0.300544" in text


def test_the_commands(tmp_path, capsys):
    """There and back; and nothing is overwritten."""
    air = held("bruneton")
    start, preset, end = (tmp_path / name for name in ("start.toml", "preset.h", "end.toml"))
    diffatmo.save(air, start)
    assert main(["export", str(start), "--preset", "bruneton", "-o", str(preset)]) == 0
    assert "All parameters are held" in capsys.readouterr().out
    assert main(["import", str(preset), "-o", str(end)]) == 0
    assert "bruneton, at 680, 550, 440 nm" in capsys.readouterr().out
    assert_same(diffatmo.load(end), air)
    for arguments in (["import", str(preset)], ["export", str(start), "--preset", "bruneton"]):
        assert main([*arguments, "-o", str(end)]) == 2
        assert "--overwrite" in capsys.readouterr().err
    assert main(["import", str(preset), "-o", str(end), "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "--luts or --preset: missing"),
        (["--preset", "unity"], "--preset"),
        (["--preset", "unreal", "--luts", "bruneton"], "--preset contradicts --luts"),
        (["--preset", "unreal", "--sun-zenith-deg", "40"], "--sun-zenith-deg contradicts --preset"),
        (["--preset", "unreal", "--orders", "4"], "--orders contradicts --preset"),
    ],
)
def test_bad_export(arguments, named, tmp_path, capsys):
    assert main(["export", "earth", "-o", str(tmp_path / "out"), *arguments]) == 2
    assert named in capsys.readouterr().err


def test_wavelengths_that_blender_has_no_ozone_for():
    with pytest.raises(PresetError, match="blender: wavelengths_nm: got"):
        presets.write(dataclasses.replace(diffatmo.earth(), wavelengths=[1200.0, 900.0, 440.0]), "blender")


BROKEN = [
    ("unreal", "MieAnisotropy=0.8", "MieAnisotropy=nan", "MieAnisotropy: got nan, expected a number of at least 0"),
    ("unreal", "MieScatteringScale=0", "MieScatteringScale=-0", "MieScatteringScale: got -0.003996"),
    ("unreal", "BottomRadius=6360.0", "BottomRadius=wide", "BottomRadius: got wide"),
    ("unreal", "(B=149", "(B=300", "GroundAlbedo.B: got 300, expected a number from 0 to 255"),
    ("unreal", "(TipAltitude=25.0,TipValue=1.0,Width=15.0)", "25", "OtherTentDistribution: got 25"),
    ("unreal", "MultiScatteringFactor=1.0", "MultiScatteringFactor=0.5", "MultiScatteringFactor: got 0.5, expected 1"),
    ("unreal", "RayleighExponentialDistribution=8.0", "RayleighExponentialDistribution=0", "rayleigh_scale_height_km"),
    ("unreal", "End Actor", "", "'End Level' without its Begin"),
    ("blender", "sky.ozone_density", "sky.turbidity", "ozone_density: missing, expected a number from 0 to 1000"),
    ("blender", "sky.air_density = ", "sky.air_density = -", "air_density: got -"),
    ("blender", "sky.air_density = ", 'sky.air_density = float("nan") + ', "air_density: got float('nan')"),
    ("blender", "sky.air_density", "sky.ozone_density = 7\nsky.air_density", "ozone_density: given twice"),
    ("blender", "links.new(", "links.new((", "not a Python script"),
    ("three-geospatial", "bottomRadius:", "radius:", "bottomRadius: missing, expected a number"),
    ("three-geospatial", "0.005802, ", "", "rayleighScattering: got 2 numbers, expected 3"),
    ("three-geospatial", "0.005802", "NaN", "rayleighScattering: got NaN, expected a number of at least 0"),
    ("three-geospatial", "new Vector3(0.00444", "(0.00444", "mieExtinction: cannot be read, expected new Vector3"),
    ("three-geospatial", "new Vector3(0.00444", "new Vector3(0.001", "mieExtinction: got [0.001, 0.00444, 0.00444]"),
    ("three-geospatial", "(0.0, 1.0, -0.125, 0.0", "(0.0, 1.0, -0.125, 0.2", "rayleighDensity: got"),
    ("three-geospatial", "(25.0, 0.0", "(20.0, 0.0", "absorptionDensity: got"),
    ("three-geospatial", "topRadius: 64", "topRadius: 4", "top_radius_km: got"),
    ("three-geospatial", "new Color(0.3", "new Color(1.3", "ground_albedo: got"),
    ("bruneton", "kGroundAlbedo =", "kAlbedo =", "kGroundAlbedo: missing or cut off"),
    ("bruneton", "kGroundAlbedo = {0.3, ", "kGroundAlbedo = {", "kGroundAlbedo: got 2 numbers, expected 3"),
    ("bruneton", "kMiePhaseFunctionG = 0", "kMiePhaseFunctionG = 1", "mie_g: got"),
    ("bruneton", "(0.0, 1.0, -0.000125, 0.0, 0.0)", "(0.0, 1.0, -0.000125)", "kRayleighDensity: expected one or two"),
]


@pytest.mark.parametrize(("target", "old", "new", "named"), BROKEN)
def test_broken_presets(target, old, new, named, tmp_path, capsys):
    text = presets.write(diffatmo.earth(), target)
    assert old in text
    file = tmp_path / "preset"
    file.write_text(text.replace(old, new, 1))
    assert main(["import", str(file), "-o", str(tmp_path / "atmosphere.toml")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{file}: {named}" in error
    assert not (tmp_path / "atmosphere.toml").exists()


@pytest.mark.parametrize("target", presets.TARGETS)
def test_a_preset_cut_off_anywhere_is_refused_or_whole(target):
    text = presets.write(held(target), target)
    whole = presets.read(text)
    refused = 0
    for length in range(0, len(text), 17):
        try:
            part = presets.read(text[:length], target)
        except PresetError:
            refused += 1
        else:
            assert_same(part, whole)
    assert refused > 20


def test_other_files(tmp_path, capsys):
    unreal, text, binary = (tmp_path / name for name in ("unreal", "text", "binary"))
    unreal.write_text(presets.write(diffatmo.earth(), "unreal"))
    text.write_text("To the lighthouse")
    binary.write_bytes(b"\xff\xfe\x00\x01")
    out = ["-o", str(tmp_path / "atmosphere.toml")]
    for arguments, named in (
        ([str(unreal), "--from", "bruneton"], f"{unreal}: not a preset of bruneton; it looks like one of unreal"),
        ([str(text)], f"{text}: not a preset that can be read; known are those of unreal"),
        ([str(binary)], f"{binary}: is no text"),
        ([str(tmp_path / "none")], "none"),
        ([str(unreal), "--wavelengths-nm", "640,540"], f"{unreal}: wavelengths: got 2"),
    ):
        assert main(["import", *arguments, *out]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert named in error
