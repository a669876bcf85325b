"""Plot a trajectory with its truth and its errors.

python examples/4_plot_the_trajectory.py DIVE poses.tum PLOT.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import aquaflow


def main(dive_folder: str, truth_file: str, plot: str) -> None:
    """Align the dive with the truth and plot path and errors."""
    dive, truth = aquaflow.read_dive(dive_folder), aquaflow.read_tum(Path(truth_file))
    # Sub-maps that never met have no common frame of reference: take the largest.
    sub_maps = dive.sub_map_of_pose
    ours = dive.trajectory.select(sub_maps == np.bincount(sub_maps).argmax())
    of_ours, of_truth = aquaflow.associate(ours.t_s, truth.t_s)
    # One camera knows no metres, so the path is scaled to the truth (Sim(3) alignment).
    found = aquaflow.align(ours.positions[of_ours], truth.positions[of_truth], with_scale=True)
    aligned = ours.select(of_ours).transform(found.T_target_source).positions
    error_m = np.linalg.norm(aligned - truth.positions[of_truth], axis=1)
    print(f"a length of 1 in {dive.unit} is {found.T_target_source.scale:.3f} m of the truth")
    print(f"absolute trajectory error: {np.sqrt((error_m**2).mean()):.4f} m RMS")

    figure, (path, errors) = plt.subplots(1, 2, figsize=(10.0, 4.0), layout="constrained")
    path.plot(*truth.positions[:, :2].T, "k-", label="truth")
    path.plot(*aligned[:, :2].T, ".", label="AquaFlow")
    path.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    path.legend()
    errors.plot(ours.t_s[of_ours], 1e3 * error_m)
    errors.set(xlabel="time, s", ylabel="position error, mm")
    figure.savefig(plot)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
