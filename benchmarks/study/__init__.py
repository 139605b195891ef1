"""The study: what the papers claim of their decision rules and what we measure, beside every rule they name."""
