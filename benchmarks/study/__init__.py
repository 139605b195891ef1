"""The study: what the papers claim of their decision rules and what we measure, next to every rule they name."""
