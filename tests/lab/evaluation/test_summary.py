"""What ``aquaflow lab evaluate`` prints: a label never touches what it labels."""

from __future__ import annotations

from aquaflow.lab.evaluation import summary

AS_TRACKED = {"psnr": 24.0, "ssim": 0.8, "psnr_as_tracked": 22.5, "ssim_as_tracked": 0.7}


def test_a_label_and_its_value_are_apart_and_all_values_stand_in_one_column() -> None:
    _, seen, tracked = summary._views(AS_TRACKED)
    assert "pose as in trajectory.tum  " in tracked
    assert seen.index("PSNR") == tracked.index("PSNR")
