"""Least squares over factors as values: blocks of factors, one Gauss-Newton, one sparse solver."""
