"""A report of a running service."""

from __future__ import annotations

from typing import Any

REPORT: dict[str, Any] = {
    "state": "tracking", "reason": "every frame has a pose", "ok": True, "frames": 120,
    "failures": 1, "overtaken": 3, "mapping_failures": 0, "steps_down": 1, "steps_up": 1,
    "telemetry_samples": 9, "fps": 9.5, "mapping_waits": 2, "keyframes": 7, "gaussians": 1000,
    "lag_ms": {"p50": 80.0, "p95": 120.0}, "classes": {"common": 100},
    "left_out_of_the_map": {'said "so"\n': 2}, "visits": {"tracking": 1},
    "stage_shares": {"track": 0.4}, "changes": [], "pose_output": None,
    "stage_failures": [
        {"stage": "pose", "error": "cv2.error", "place": 'a "b"', "defect": False, "count": 2}
    ],
    "devices": {
        "front": {
            "kind": "camera", "state": "streaming", "reason": "", "received": 123456789,
            "delivered": 100, "overtaken": 3, "passed_over": 4, "unusable": 5, "duplicates": 6,
            "lost": 7, "stamps_repaired": 8, "reconnects": 9, "rate_hz": 14.9, "age_s": 0.05,
            "lag_ms": 36.0,
        },
        'the "dvl"\n': {
            "kind": "link", "state": "lost", "reason": "no byte for 10 s", "bytes": 10,
            "messages": 11, "samples": 12, "bad_checksums": 13, "garbage_bytes": 14,
            "invalid_values": 15, "unheard": 16, "dropped_samples": 17, "reconnects": 18,
            "rate_hz": None, "age_s": None, "lag_ms": None,
        },
        "recorder": {"kind": "recorder", "state": "recording", "reason": ""},
    },
}  # fmt: skip
