"""Benchmarks of `sameas` and of other programs; README.md lists what each prints. Run ``scripts/bench NAME``."""
