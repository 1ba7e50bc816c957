"""One description per document: the classes that a file's content becomes carry what the file may say.

A field of a dataclass is described by a :class:`~fgreg.schema.record.Key` in its ``Annotated`` type. From that come
reading with all problems at once and writing (:mod:`~fgreg.schema.record`), JSON Schemas (``fgreg schema``), and the
tables of the format page (``tools/make_format_tables.py``).
"""
