"""For the site: links from the pages to the source, which is not on the site, become the source's name."""

import re


def on_page_markdown(markdown, **_):
    return re.sub(r"\[([^\]]+)\]\(\.\./src/([\w/]+\.py)\)", r"\1 (`\2`)", markdown)
