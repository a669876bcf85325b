"""The frame gate: frames that cannot help are skipped before costly work."""
