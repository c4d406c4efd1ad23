"""Reads files of earlier versions of headbench; older formats are handled only here.

Version 1 of ``run.json`` and of rows had no conditions. They were part of the method's name ("ours+1-4"), and separate fields
of the manifest described the changes of a sweep or a curve.
"""

from __future__ import annotations

from typing import Any

import pandas as pd

from .condition import CONDITION_MARK


def upgraded_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with a column ``condition``, which version 1 lacks; see `Rows.split`."""
    return table if "condition" in table else table.assign(condition="")


def upgraded_manifest(record: dict[str, Any]) -> dict[str, Any]:
    """Convert the content of ``run.json`` to version 2; other versions are returned unchanged and checked by the reader."""
    if record.get("format") != 1 or not isinstance(record.get("methods"), list):
        return record
    renewed = {**record, "format": 2}
    renewed.pop("evaluated", None)
    source = renewed.pop("sweep_of", None)
    curve = renewed.pop("curve_of", None)
    conditions: dict[str, dict[str, Any]] = {}
    methods = []
    for entry in record["methods"]:
        if not isinstance(entry, dict):
            return record
        entry = dict(entry)
        derived = entry.pop("derived", None) or {}
        name, _, condition = str(entry.get("name")).partition(CONDITION_MARK)
        if not (source or curve):  # the separator is part of a name
            name, condition = str(entry.get("name")), ""
        entry |= {"name": name, "condition": condition}
        methods.append(entry)
        known = conditions.setdefault(condition, {"name": condition, "methods": []})
        known["methods"].append(name)
        if derived:
            known["derive"] = {"name": "variant", "parameters": {"name": str(derived.get("variant"))}}
    renewed["methods"] = methods
    if source or curve:
        configuration = renewed.get("configuration")
        if isinstance(configuration, dict):
            more = {"source": source} if source else {}
            renewed["configuration"] = {**configuration, "conditions": [*conditions.values()], **more}
    return renewed
