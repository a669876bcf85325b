"""Devices on the vehicle's network, for ``aquaflow doctor devices``: they are listened to, or asked
what their makers' documents let anyone ask. Nothing is set, and no address is tried that was not
given or is not a documented default."""
