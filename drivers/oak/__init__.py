"""Luxonis OAK cameras; the vendor's library is used through a small protocol."""

from aquaflow.drivers.oak.camera import OakCamera

__all__ = ["OakCamera"]
