"""Least squares: one descent for every problem, robust kernels, covariance."""
