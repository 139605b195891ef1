"""What STILTS and NWAY call an option, and what it is called here: for the refusal of their arguments."""

from __future__ import annotations

import os
from collections.abc import Sequence

import typer

from sameas.front.options import NO_RADIUS

#: For options that give a radius.
NO_RADIUS_NEEDED = f"No radius is needed: {NO_RADIUS}, or give --sigma ARCSEC."
#: Options of NWAY, and what to do instead.
NWAY = {
    "--prior-completeness": "Completeness is estimated, by magnitude if there is one.",
    "--mag": "Magnitudes are evidence by themselves; --column2 NAME takes another column, --column2 NAME=histogram.txt "
    "odds of yours.",
    "--mag-radius": "What the column of a partner is like is learned from all pairs, weighted by their probabilities.",
    "--mag-auto-minprob": "What the column of a partner is like is learned from all pairs, weighted by their "
    "probabilities.",
    "--acceptable-prob": "match_flag is 2 for candidates at least half as probable as the best.",
    "--min-prob": "All candidates are written by --join pairs; select by p_match.",
}
#: Arguments KEY=VALUE of STILTS, and what to do instead; {} stands for the value.
STILTS = {
    **dict.fromkeys(("in1", "in2", "out", "ofmt", "omode"), "Write sameas match FIRST SECOND -o OUT."),
    "join": "Write --join {}.",
    "find": "The answer is always one to one; --join pairs writes all candidates.",
    **dict.fromkeys(("error", "params", "matcher"), NO_RADIUS_NEEDED),
    **{
        f"values{k}": f"Write --ra{k} NAME --dec{k} NAME --sigma{k} NAME, or --ellipse{k} A,B,PA (one σ)." for k in "12"
    },
    **{f"{word}{k}": f"Write --{word}{k} {{}}." for word in ("ra", "dec") for k in "12"},
    **{f"ifmt{k}": f"Write --format{k} {{}}." for k in "12"},
}


def refuse_arguments_of_stilts(arguments: Sequence[str]) -> None:
    """Raises a refusal that says our option, if an argument is one of STILTS and not a file."""
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if equals and key in STILTS and not os.path.exists(argument):
            raise typer.BadParameter(STILTS[key].format(value), param_hint=argument)
