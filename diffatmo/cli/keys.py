"""Kinds of values that users give, in files and on the command line: what each accepts, and how it is refused."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from diffatmo.cli.common import InputError

if TYPE_CHECKING:
    from diffatmo.camera import Camera


@dataclass(frozen=True)
class Number:
    """A key whose value is a number from ``lowest`` to ``highest``; with ``positive``, ``lowest`` is 0 and left out."""

    help: str
    lowest: float = -math.inf
    highest: float = math.inf
    positive: bool = False

    @property
    def expected(self) -> str:
        """The accepted values in words."""
        if math.isinf(self.lowest):
            return "a number"
        if math.isinf(self.highest):
            return f"a number {'above' if self.positive else 'of at least'} {self.lowest:g}"
        return f"a number from {self.lowest:g} to {self.highest:g}" + ", not 0" * self.positive

    def read(self, value: Any) -> float:
        """The value, or :class:`ValueError`."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError
        if not self.lowest <= value <= self.highest or (self.positive and value == self.lowest):
            raise ValueError
        return float(value)


@dataclass(frozen=True)
class Word:
    """A key whose value is one of ``choices``, or any text where there are none."""

    help: str
    choices: tuple[str, ...] = ()

    @property
    def expected(self) -> str:
        """The accepted values in words."""
        return " or ".join(f'"{choice}"' for choice in self.choices) if self.choices else "text"

    def read(self, value: Any) -> str:
        """The value, or :class:`ValueError`."""
        if not isinstance(value, str) or not value or (self.choices and value not in self.choices):
            raise ValueError
        return value


@dataclass(frozen=True)
class Flag:
    """A key whose value is true or false."""

    help: str
    expected: str = "true or false"

    def read(self, value: Any) -> bool:
        """The value, or :class:`ValueError`."""
        if not isinstance(value, bool):
            raise ValueError
        return value


@dataclass(frozen=True)
class Numbers:
    """A key whose value is a list of numbers, as text with commas between them; of ``count`` numbers where that is not None."""

    help: str
    expected: str = "numbers, like -0.2, 0.05"
    count: int | None = None

    def read(self, value: Any) -> list[float]:
        """The value, or :class:`ValueError`."""
        items = [float(item) for item in value.split(",")] if isinstance(value, str) else value
        if not isinstance(items, list) or len(items) != (self.count or len(items)):
            raise ValueError
        return [Number("").read(item) for item in items]


@dataclass(frozen=True)
class Moment:
    """A key whose value is a date and time with its offset from UTC, of a TOML file or as text."""

    help: str
    expected: str = "a date and time with its offset from UTC, like 2024-06-21T12:00:00+02:00"

    def read(self, value: Any) -> datetime:
        """The value, or :class:`ValueError`."""
        if isinstance(value, str):
            value = datetime.fromisoformat(value)
        if not isinstance(value, datetime) or value.utcoffset() is None:
            raise ValueError
        return value


Key = Number | Numbers | Word | Flag | Moment

MAPPINGS = ("equidistant", "equisolid", "stereographic", "orthographic")
"""Those of ``diffatmo.camera``, which takes seconds to import; a test compares the two."""

CAMERA_KEYS: dict[str, Key] = {
    "projection": Word("How pixels map to directions.", ("equirectangular", "fisheye", "pinhole")),
    "upper": Flag("The equirectangular picture ends at the horizon."),
    "fov_deg": Number("Field of view: across the circle of a fisheye, top to bottom of a pinhole.", 0.01, 360),
    "mapping": Word("Of a fisheye.  [default: equidistant]", MAPPINGS),
    "distortion": Numbers("k1,k2,k3,p1,p2 of a pinhole (Brown and Conrady), k1,k2,... of a fisheye.  [default: none]"),
    "circle": Number(
        "Diameter of a fisheye's circle, in units of the picture's shorter side.  [default: 1]", 0, 100, positive=True
    ),
    "yaw_deg": Number("Azimuth of the optical axis, or of a panorama's left edge, clockwise from north.", -3600, 3600),
    "pitch_deg": Number("Elevation of the optical axis.", -90, 90),
    "roll_deg": Number("Clockwise turn of the camera about its optical axis.", -3600, 3600),
}
"""How a camera is described."""

PLACE_KEYS: dict[str, Key] = {
    "altitude_km": Number("Height of the camera above the ground.", 0, 1e9),
    "sun_zenith_deg": Number("Zenith angle of the sun; above 90 it is below the horizon.", 0, 180),
    "sun_azimuth_deg": Number("Azimuth of the sun, clockwise from north.", -3600, 3600),
    "time": Moment("Instead, with a latitude and a longitude: when it is, like 2024-06-21T12:00:00+02:00."),
    "latitude_deg": Number("Where it is, north positive.", -90, 90),
    "longitude_deg": Number("Where it is, east positive.", -180, 180),
}
"""Where the camera and the sun are."""


def read(key: Key, name: str, value: Any) -> Any:
    """``value``, checked; raises :class:`InputError` naming the key and what it accepts."""
    try:
        return key.read(value)
    except ValueError as error:
        shown = value if isinstance(value, datetime) else repr(value)
        raise InputError(f"{name}: got {shown}, expected {key.expected}") from error


def options(keys: Mapping[str, Key], shown: Mapping[str, Any] | None = None) -> Callable[[Any], Any]:
    """A decorator that adds an option for each key: ``--sun-zenith-deg`` for ``sun_zenith_deg``, None if not given.

    ``shown`` are the defaults that the help mentions.
    """

    def decorate(command: Any) -> Any:
        for name, key in reversed(list(keys.items())):
            flag, metavar = flag_of(name), None
            kind: click.ParamType | None = None
            default = f"  [default: {shown[name]}]" if shown and name in shown else ""
            if isinstance(key, Flag):
                flag += f"/--no-{name.replace('_', '-')}"
            elif isinstance(key, Number):
                kind, metavar = click.FLOAT, "NUMBER"
            elif isinstance(key, Moment | Numbers):
                metavar = "TIME" if isinstance(key, Moment) else "NUMBER,..."
            elif key.choices:
                kind = click.Choice(key.choices)
            command = click.option(flag, name, type=kind, metavar=metavar, default=None, help=key.help + default)(
                command
            )
        return command

    return decorate


class Headed(click.Command):
    """A command with so many options that its help lists them under headings, each above the option it is given for."""

    def __init__(self, *args: Any, headings: Mapping[str, str], **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.headings = headings

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of the help."""
        rows: dict[str, list[tuple[str, str]]] = {}
        heading = "Options"
        for option in self.get_params(ctx):
            heading = self.headings.get(option.name or "", heading)
            record = option.get_help_record(ctx)
            if record is not None and not isinstance(option, click.Argument):
                rows.setdefault(heading, []).append(record)
        for heading, own in rows.items():
            with formatter.section(heading):
                formatter.write_dl(own)


def flag_of(name: str) -> str:
    """The option of a key."""
    return f"--{name.replace('_', '-')}"


def given(keys: Mapping[str, Key], values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the options of ``keys`` that were given on the command line, checked."""
    return {name: read(key, flag_of(name), values[name]) for name, key in keys.items() if values[name] is not None}


def check_camera_options(options: Mapping[str, Any]) -> None:
    """Refuse a description of a camera that contradicts itself."""
    projection = options.get("projection")
    if options.get("upper") and projection not in (None, "equirectangular"):
        raise InputError(f"upper contradicts projection {projection}: it belongs to equirectangular")
    if "fov_deg" in options and projection == "equirectangular":
        raise InputError("fov_deg contradicts projection equirectangular, which shows the whole sphere or half of it")
    if projection == "pinhole" and options.get("fov_deg", 0) >= 180:
        raise InputError(f"fov_deg: got {options['fov_deg']:g}, expected less than 180 for projection pinhole")


def check_sun_options(options: Mapping[str, Any], *, complete: bool = True) -> None:
    """Refuse a place of the sun that contradicts itself or is said in part; unless ``complete``, time or place may be."""
    found_by = ("time", "latitude_deg", "longitude_deg")
    said = [key for key in found_by if key in options]
    angles = [key for key in ("sun_zenith_deg", "sun_azimuth_deg") if key in options]
    if "sun" in options and (angles or said):
        raise InputError(f'sun = "detect" contradicts {" and ".join(angles + said)}: give one or the other')
    if angles and said:
        raise InputError(f"{said[0]} contradicts {angles[0]}: the sun is found from {', '.join(found_by)}, or given")
    # Of what a file may complete, a place is one thing.
    whole = found_by if complete else tuple(key for key in found_by[1:] if set(found_by[1:]) & set(said))
    missing = [key for key in whole if key not in options]
    if said and missing:
        raise InputError(f"{missing[0]}: missing, the sun is found from {', '.join(found_by)} together")


def with_sun(options: Mapping[str, Any]) -> dict[str, Any]:
    """``options`` with the angles of the sun in place of time, latitude and longitude, if those are given."""
    check_sun_options(options)
    if "time" not in options:
        return dict(options)
    import numpy as np

    from diffatmo import sun

    place = {key: options[key] for key in ("latitude_deg", "longitude_deg", "altitude_km") if key in options}
    zenith, azimuth = np.degrees(sun.angles(sun.position(options["time"], **place))).tolist()
    others = {key: value for key, value in options.items() if key not in ("time", "latitude_deg", "longitude_deg")}
    return others | {"sun_zenith_deg": zenith, "sun_azimuth_deg": azimuth}


def make_camera(description: Mapping[str, Any], *, height: int, width: int) -> "Camera":
    """The camera described by ``CAMERA_KEYS``; what is missing takes its default."""
    from diffatmo import camera

    data = {**description, "height": height, "width": width}
    if data["projection"] == "pinhole" and "fov_deg" in data:
        data["fov_y_deg"] = data.pop("fov_deg")
    return camera.from_dict(data)
