"""The user-level interface: sources in any form go in, result objects with reports, plots and files come out.

:func:`~sameas.front.match.match` and its siblings convert the user's input and call the stages below; the command line
does the same with files. :mod:`~sameas.front.options` declares the options of both; :mod:`~sameas.front.tables`
converts input to tables; :mod:`~sameas.front.request` stores the request, so that it can be written to the output, and
:mod:`~sameas.front.provenance` what was estimated.
"""
