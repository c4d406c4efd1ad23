"""Reads what earlier versions of headbench stored: the only place that knows older formats.

Version 1 of ``run.json`` and of rows had no conditions. A method's name carried them ("ours+1-4"), and the manifest said in
fields of its own what a sweep or a curve had changed.
"""

from __future__ import annotations

from typing import Any

import pandas as pd

from .condition import CONDITION_MARK


def upgraded_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with a column ``condition``, which version 1 lacks; see `Rows.split`."""
    return table if "condition" in table else table.assign(condition="")


def upgraded_manifest(record: dict[str, Any]) -> dict[str, Any]:
    """The content of ``run.json`` in version 2; of another version as it is, which the reader checks."""
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
        if not (source or curve):  # the mark is part of a name
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
