"""The front door: anything that holds positions goes in, a result worth looking at comes out.

:func:`~sameas.front.match.match` and its like take what users have and call the stages below; the command does the same
with files. :mod:`~sameas.front.options` declares the options of both, once; :mod:`~sameas.front.tables` turns what
users have into tables; :mod:`~sameas.front.request` keeps what was asked for, and says it again in the output.
"""
