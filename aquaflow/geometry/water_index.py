"""The refractive index of water, relative to the air inside a housing."""

from __future__ import annotations

GREEN_NM = 550.0
"""Wavelength, nm, at which a colour camera in water sees most of its detail."""
DECIBAR_PER_METRE = 1.0076
"""Hydrostatic pressure of sea water of 1027 kg/m^3."""
COMPRESSIBILITY_PER_DBAR = 4.4e-6
"""Of sea water at 10 degrees C: 4.4e-10 per Pa (UNESCO 1983, equation of state)."""

SEA_SALINITY_PSU = 35.0
"""Of the open ocean."""
TEMPERATURE_C = 10.0
"""Between a Norwegian winter and a summer in Kobe; 10 degrees C change the index by 0.0009."""


def water_index(
    salinity_psu: float = SEA_SALINITY_PSU,
    temperature_c: float = TEMPERATURE_C,
    depth_m: float = 0.0,
    wavelength_nm: float = GREEN_NM,
) -> float:
    """Refractive index of water relative to air.

    At the surface by X. Quan and E. S. Fry, "Empirical equation for the index of refraction of
    seawater", Applied Optics 34 (1995) 3477, good to 1.5e-5 for 0 to 35 psu, 0 to 30 degrees C and
    400 to 700 nm. Below, the law of Gladstone and Dale, that n - 1 grows as the density, which
    pressure raises: 0.0015 per 1000 m, as the tables of Austin and Halikas (1976) have it.
    """
    S, T, wave = salinity_psu, temperature_c, wavelength_nm
    n = (
        1.31405
        + (1.779e-4 - 1.05e-6 * T + 1.6e-8 * T**2) * S
        - 2.02e-6 * T**2
        + (15.868 + 0.01155 * S - 0.00423 * T) / wave
        - 4382.0 / wave**2
        + 1.1455e6 / wave**3
    )
    denser = 1.0 + COMPRESSIBILITY_PER_DBAR * DECIBAR_PER_METRE * depth_m
    return 1.0 + denser * (n - 1.0)


SEA_WATER = water_index()
FRESH_WATER = water_index(salinity_psu=0.0)
