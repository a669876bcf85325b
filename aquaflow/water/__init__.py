"""The medium and the light: image formation, estimation (Sec. 3.3.2), exposure."""
