"""Figures that must not get worse: computed on shared recordings and made worlds, and compared between commits."""
