"""What channels see of a spectrum: splines that reproduce what splines do, and integrals done another way."""

import numpy as np
import pytest

from diffatmo import bands, color, spectrum

NODES = (400.0, 450.0, 520.0, 610.0, 700.0)


def test_splines_are_one_at_their_own_node_and_zero_at_the_others():
    """In whatever order the nodes come."""
    for nodes in (NODES, NODES[::-1], (520.0, 400.0, 700.0, 610.0, 450.0)):
        np.testing.assert_allclose(bands.interpolation(nodes, np.array(nodes)), np.eye(5), atol=1e-12)


def test_splines_reproduce_cubics():
    """Not-a-knot splines do, exactly, between the nodes and beyond them; and so they add up to 1."""
    at = np.linspace(380, 730, 50)
    matrix = bands.interpolation(NODES, at)
    cubic = np.polynomial.Polynomial([1.0, -0.7, 0.4, 2.0], domain=[400, 700], window=[-1, 1])
    np.testing.assert_allclose(matrix @ cubic(np.array(NODES)), cubic(at), atol=1e-11)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-12)


def test_the_spectrum_of_the_sun_is_white():
    picture = bands.srgb()
    assert picture.names == ("red", "green", "blue")
    np.testing.assert_allclose(picture.response.sum(axis=1), 1, atol=1e-12)
    # Where the curves of the observer peak, drawn apart by the matrix: in order, and within 30 nm of sRGB's primaries'.
    np.testing.assert_allclose(picture.centres, [600, 550, 460], atol=30)


SPECTRA = {
    "clear": lambda nm: (550 / nm) ** 4 * np.exp(-0.1 * (550 / nm) ** 4),
    "haze": lambda nm: (550 / nm) * np.exp(-0.3 * (550 / nm) ** 1.3),
    "through five air masses": lambda nm: (550 / nm) ** 4 * np.exp(-0.5 * (550 / nm) ** 4),
}


@pytest.mark.parametrize("name", SPECTRA)
def test_srgb_is_an_integral_over_the_spectrum(name):
    """Against a sum in steps of 1 nm with nothing between: a smooth spectrum is seen to 0.3 %, as the module says."""
    sky, picture = SPECTRA[name], bands.srgb()
    table, matching = color.observer()
    fine = np.arange(360.0, 831.0)
    curves = np.stack([np.interp(fine, table, curve) for curve in (matching @ color.XYZ_TO_SRGB.T).T], axis=-1)
    sunlight = curves * np.asarray(spectrum.solar_irradiance(fine))[:, None]
    direct = sky(fine) @ sunlight / sunlight.sum(axis=0)
    np.testing.assert_allclose(picture.response @ sky(np.array(picture.nodes)), direct, rtol=3e-3)


def test_a_narrow_band_is_the_radiance_there():
    """A spectrometer that looks at the nodes sees L/E times its sun; between them what the spline says."""
    sun_there = np.array([1.5, 1.9, 2.0, 1.7, 1.4])
    seen = bands.narrow(np.array(NODES), sun_there, nodes=NODES)
    np.testing.assert_allclose(seen.response, np.diag(sun_there), atol=1e-12)
    assert seen.names == ("400", "450", "520", "610", "700")
    between = bands.narrow(np.array([480.0]), np.array([2.0]), nodes=NODES)
    line = np.array(NODES) / 500
    np.testing.assert_allclose(between.response @ line, 2 * 480 / 500, rtol=1e-12)


def test_a_channel_of_one_line_is_narrow():
    """A triangle as narrow as the steps of the integral sees one wavelength, whatever its height."""
    for height in (1.0, 1e-3):
        wide = bands.integrated(
            height * np.array([[0.0], [1.0], [0.0]]), np.array([545.0, 550.0, 555.0]), names=["one"], nodes=NODES
        )
        np.testing.assert_allclose(wide.response, bands.interpolation(NODES, np.array([550.0])), atol=1e-12)
        assert wide.centres == pytest.approx([550])


AT = np.array([450.0, 550.0, 650.0])


@pytest.mark.parametrize(
    ("curves", "at", "nodes", "message"),
    [
        (np.ones((3, 1)), AT, NODES[:3], r"nodes: got \[400.0, 450.0, 520.0\] nm, expected at least four different"),
        (np.ones((3, 1)), AT, (400, 500, 500, 600), "nodes: got .* expected at least four different wavelengths"),
        (np.ones((3, 1)), AT, (400, 500, np.nan, 600), "nodes: got .* expected at least four different wavelengths"),
        (np.array([[1.0], [np.nan], [1.0]]), AT, NODES, "sensitivity: expected finite numbers"),
        (np.ones((3, 1)), np.array([450.0, 550.0, np.inf]), NODES, "sensitivity: expected finite numbers"),
        (np.zeros((3, 1)), AT, NODES, "sensitivity: channel one sees no light"),
        (-np.ones((3, 1)), AT, NODES, "sensitivity: channel one sees no light"),
        (np.ones((3, 1)), np.array([300.0, 550.0, 650.0]), NODES, "sensitivity: reaches beyond 360 to 840 nm"),
        (np.ones((3, 1)), np.array([450.0, 550.0, 900.0]), NODES, "sensitivity: reaches beyond 360 to 840 nm"),
        (np.ones((3, 1)), AT[::-1], NODES, r"sensitivity: got shape \(3, 1\) .* wavelengths that rise"),
        (np.ones((3, 2)), AT, NODES, r"sensitivity: got shape \(3, 2\) at 3 wavelengths, expected \(3, 1\)"),
    ],
)  # fmt: skip
def test_refuses(curves, at, nodes, message):
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        bands.integrated(curves, at, names=["one"], nodes=nodes)
    assert "\n" not in str(caught.value)


def test_sensitivities_may_be_known_beyond_what_they_see():
    """Zeros beyond the spectrum of the sun that is known are no light."""
    inside = bands.integrated(np.ones((2, 1)), np.array([450.0, 650.0]), names=["one"], nodes=NODES)
    wide = bands.integrated(
        np.array([[0.0], [0.0], [1.0], [1.0], [0.0], [0.0]]),
        np.array([300.0, 449.999, 450.0, 650.0, 650.001, 1000.0]), names=["one"], nodes=NODES,
    )  # fmt: skip
    np.testing.assert_allclose(wide.response, inside.response, atol=1e-12)
