"""One description per document: the classes for a file's content define what the file may contain.

A field of a dataclass is described by a :class:`~fgreg.schema.record.Key` in its ``Annotated`` type. This gives
reading with all problems at once and writing (:mod:`~fgreg.schema.record`), JSON Schemas (``fgreg schema``), and the
tables of the format page (``tools/make_format_tables.py``).
"""
