"""A dive as maps that surveyors use: true orthophotos and elevations, drawn from the Gaussians."""
