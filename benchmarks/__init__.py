"""What is measured of `sameas`, beside its peers; README.md says what each script prints. Run by ``scripts/bench``."""
