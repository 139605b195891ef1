"""Pages run their own script and nothing else, whatever the names in them are."""

import base64
import hashlib
import re

import numpy as np
import pytest

from browser import CHROMIUM, Browser
from charted import charted
from sameas.pages.map import map_page
from sameas.pages.template import asset, page_of, script_safe

HOSTILE = '</script><script>document.title="taken"</script><img src=x onerror="document.title=1">{{js}}{{policy}}'
TEMPLATES = ["map.html", "frame.html", "series.html", "movers.html"]


def filled(template, title="", **marks):
    names = ("css", "data", "texts", "columns", "picture")
    return page_of(template, title, "page", dict.fromkeys(names, "") | {"js": "1 < 2;"} | marks)


@pytest.mark.parametrize("template", TEMPLATES)
def test_the_policy_names_the_digest_of_the_script_and_no_other_source(template):
    page = filled(template, data=script_safe({"name": HOSTILE}))
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules.pop("script-src") == f"'sha256-{digest}'"
    assert rules.pop("default-src") == "'none'" and rules.pop("img-src") == "data:"
    assert rules == {"style-src": "'unsafe-inline'", "base-uri": "'none'", "form-action": "'none'"}
    # The policy counts for what comes after it.
    assert page.index("Content-Security-Policy") < page.index("<title>")


@pytest.mark.parametrize("template", TEMPLATES)
def test_what_stands_for_a_mark_is_no_mark_itself(template):
    page = filled(template, title="{{data}}", data=script_safe({"name": HOSTILE}))
    assert "<title>{{data}}" in page and page.count("{{js}}") == 1 and HOSTILE not in page


def test_templates_have_no_handlers_that_the_policy_would_stop():
    for template in ["head.html", *TEMPLATES]:
        assert not re.search(r"\son\w+=|javascript:", asset(template))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
def test_a_script_that_got_into_a_page_is_not_run(tmp_path):
    page = map_page(charted(12, 4, names={1: HOSTILE}))
    broken = page.replace("<body>", "<body>" + HOSTILE.replace("</script><script>", "<script>", 1), 1)
    assert broken != page and np.char.count(broken, "document.title=1") > 0
    (tmp_path / "map.html").write_text(broken, encoding="utf-8")
    browser = Browser(tmp_path / "profile", tmp_path / "map.html")
    try:
        assert browser.js("document.title").endswith("map")  # and the page's own script has made it ready
        assert not [url for url in browser.requests if not url.startswith(("file:", "data:"))]
    finally:
        browser.close()
