"""Physical constants, with their sources."""

import math

SUN_ANGULAR_RADIUS = math.radians(0.2666)
"""Mean angular radius of the sun seen from Earth, rad (IAU 2015 solar radius 695 700 km at 1 au)."""

SUN_SOLID_ANGLE = 2 * math.pi * 2 * math.sin(SUN_ANGULAR_RADIUS / 2) ** 2
"""Solid angle of that disc, sr; 1 - cos written without cancellation."""

EARTH_RADIUS_KM = 6360.0
"""Bottom radius used by Bruneton & Neyret 2008 and by every sky renderer since, km."""

MARS_RADIUS_KM = 3389.5
"""Volumetric mean radius of Mars, km (NASA planetary fact sheet)."""

DOBSON_UNIT = 2.6867e20
"""Molecules per square metre in one Dobson unit (Brion et al. conventions; 10 µm of ozone at STP)."""

LOSCHMIDT = 2.546899e25
"""Molecules per cubic metre of air at 288.15 K and 1013.25 hPa (Bodhaine et al. 1999, eq. 6 ff.)."""

GAS_CONSTANT = 8.314462618
"""J mol^-1 K^-1 (CODATA 2018, exact)."""

MOLAR_MASS_AIR = 0.0289644
"""Of dry air, kg mol^-1 (US Standard Atmosphere 1976)."""

GRAVITY = 9.80665
"""Standard acceleration of free fall, m s^-2."""
