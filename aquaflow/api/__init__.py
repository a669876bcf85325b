"""The public interface in Python; its names are reached as ``aquaflow.NAME``."""
