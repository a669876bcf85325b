"""Simulated instruments: samples of the vehicle's sensors along the path, and their file.

``telemetry.csv`` has the columns t_s, arrival_s, kind, source, v0, v1, v2, v3, in order of arrival:

- ``depth``: v0 metres below the surface;
- ``attitude``: v0..v3 quaternion wxyz of the body (forward, right, down) in NED;
- ``angular_rate``: v0..v2 rad/s, body frame;
- ``velocity``: v0..v2 m/s over ground, body frame, v3 figure of merit (1 sigma, m/s).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.errors import InputError, reason_of
from aquaflow.messages import AngularRate, Attitude, Depth, TelemetrySample, Velocity
from aquaflow.synthetic.config import SyntheticConfig
from aquaflow.synthetic.path import Path as VehiclePath

__all__ = ["HEADER", "read_telemetry", "write_telemetry"]

Array: TypeAlias = npt.NDArray[np.float64]

HEADER = ("t_s", "arrival_s", "kind", "source", "v0", "v1", "v2", "v3")
"""Columns of telemetry.csv; the values of each kind are in v0 to v3."""
SOURCE = "synthetic"
"""The instruments' name in telemetry.csv."""


def write_telemetry(
    path: Path, config: SyntheticConfig, vehicle: VehiclePath, rng: np.random.Generator
) -> None:
    """Measure along ``vehicle`` and write the samples in order of arrival."""
    rows: list[tuple[float, float, str, Array]] = []
    for kind, rate_hz in _rates(config).items():
        last = (config.frames - 1) / config.fps
        t = np.arange(int(last * rate_hz + 1e-9) + 1) / rate_hz
        values = _measure(kind, t, config, vehicle, rng)
        late = rng.exponential(config.telemetry.latency_s, len(t))
        # One device's messages arrive in the order in which they were sent.
        arrival = np.maximum.accumulate(t + late)
        rows += [(float(t[k]), float(arrival[k]), kind, values[k]) for k in range(len(t))]
    rows.sort(key=lambda row: row[1])
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        for t_s, arrival_s, kind, value in rows:
            cells = [f"{v:.9g}" for v in value] + [""] * (4 - len(value))
            writer.writerow([f"{t_s:.9f}", f"{arrival_s:.9f}", kind, SOURCE, *cells])


def _rates(config: SyntheticConfig) -> dict[str, float]:
    noise = config.telemetry
    return {
        "depth": noise.depth_hz,
        "attitude": noise.attitude_hz,
        "angular_rate": noise.rate_hz,
        "velocity": noise.dvl_hz,
    }


def _measure(
    kind: str,
    t: Array,  # [N] s
    config: SyntheticConfig,
    vehicle: VehiclePath,
    rng: np.random.Generator,
) -> Array:
    """Values [N, 1..4] of one instrument at times t [N]."""
    noise = config.telemetry
    white = rng.standard_normal((len(t), 3))
    if kind == "depth":
        return vehicle.centre_w(t)[:, 2:] + noise.depth_sigma_m * white[:, :1]
    if kind == "angular_rate":
        return vehicle.rate_b(t) + noise.rate_sigma_rad_s * white
    R_wb = vehicle.R_wb(t)
    if kind == "attitude":
        error = Rotation.from_rotvec(np.radians(noise.attitude_sigma_deg) * white)
        xyzw = (Rotation.from_matrix(R_wb) * error).as_quat(canonical=True)
        return np.asarray(np.roll(xyzw, 1, axis=1))
    velocity = np.einsum("nji,nj->ni", R_wb, vehicle.velocity_w(t))
    merit = np.full((len(t), 1), noise.dvl_sigma_m_s)
    return np.hstack([velocity + noise.dvl_sigma_m_s * white, merit])


def read_telemetry(path: Path) -> Iterator[TelemetrySample]:
    """Samples of a ``telemetry.csv`` in the order of the file, which is that of arrival.

    Raises:
        InputError: the file is missing, or a line of it is not as the module's text says.
    """
    try:
        with path.open(newline="") as file:
            for line in csv.DictReader(file):
                yield _sample(line)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the telemetry {path}: {reason_of(error)}") from error
    except (KeyError, TypeError, ValueError, OverflowError, csv.Error) as error:
        raise InputError(
            f"{path} holds a line that is no telemetry sample; its columns must be "
            f"{', '.join(HEADER)}"
        ) from error


def _sample(line: dict[str, str]) -> TelemetrySample:
    t_ns, arrival_ns = (round(float(line[key]) * 1e9) for key in ("t_s", "arrival_s"))
    kind, source = line["kind"], line["source"]
    if kind == "depth":
        return Depth(t_ns, arrival_ns, source, float(line["v0"]))
    x, y, z = float(line["v0"]), float(line["v1"]), float(line["v2"])
    if kind == "angular_rate":
        return AngularRate(t_ns, arrival_ns, source, (x, y, z))
    last = float(line["v3"])
    if kind == "velocity":
        return Velocity(t_ns, arrival_ns, source, (x, y, z), last)
    if kind == "attitude":
        return Attitude(t_ns, arrival_ns, source, (x, y, z, last))
    raise ValueError(f"unknown kind '{kind}'")
