"""Runs an unmodified script of an official repository after the changes of a plan: ``launch.py PLAN SCRIPT ...``.

It is run by the interpreter of the authors' code and imports headbench only for the CPU shim. A copy of this file is
written beside the plan.
"""

import json
import os
import sys
from importlib.machinery import SourceFileLoader
from typing import Any


def main() -> None:
    """Read the plan, apply its changes, and run the script in this process."""
    with open(sys.argv[1], encoding="utf-8") as stream:
        plan = json.load(stream)
    script = os.path.abspath(sys.argv[2])
    sys.argv = sys.argv[2:]
    sys.path[0] = os.path.dirname(script)  # instead of this file's folder, as Python does for a script
    if plan["shim"]:
        from headbench.methods.official.shim.cpu import install

        install(plan["threads"], plan["shim"])
    if plan["patches"]:
        patch_sources(plan["patches"], os.path.dirname(script))
    if plan["order"]:
        feed_order(plan["order"])
    main_module = sys.modules["__main__"]
    main_module.__file__ = script
    SourceFileLoader("__main__", script).exec_module(main_module)


def patch_sources(patches: Any, root: str) -> None:
    """Replace texts in sources below ``root`` when they are compiled; files stay as they are.

    ``patches`` are [file, old text, new text]; each old text must occur in its file.
    """
    sys.pycache_prefix = os.path.join(
        root, "no-such-folder"
    )  # cached bytecode was compiled without the patches
    by_path: dict = {}
    for file, old, new in patches:
        by_path.setdefault(os.path.realpath(os.path.join(root, file)), []).append((old, new))
    loader: Any = SourceFileLoader
    compiled = loader.source_to_code

    def source_to_code(self: Any, data: Any, path: Any, **options: Any) -> Any:
        for old, new in by_path.get(os.path.realpath(path), ()):
            if old.encode() not in data:
                sys.exit(
                    f"{path}: expected {old!r}, found none; this commit is not the one that the adapter supports"
                )
            data = data.replace(old.encode(), new.encode())
        return compiled(self, data, path, **options)

    loader.source_to_code = source_to_code


def feed_order(order: Any) -> None:
    """Make random loaders return the images with these names in this order.

    Patched code without such a loader reads the names from ``images_in_order``.
    """
    import builtins

    import torch.utils.data

    vars(builtins)["images_in_order"] = order
    data: Any = torch.utils.data
    stock = data.DataLoader

    def loader(dataset: Any, shuffle: bool = False, sampler: Any = None, **options: Any) -> Any:
        if not shuffle and sampler is None:
            return stock(dataset, **options)
        index = {os.path.basename(camera.image_path): at for at, camera in enumerate(dataset.cameras)}
        return stock(dataset, sampler=[index[name] for name in order], **options)

    data.DataLoader = loader


if __name__ == "__main__":
    main()
