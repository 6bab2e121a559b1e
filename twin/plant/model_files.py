"""Reads model files, and refuses those that reach outside the models' folder."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco

from twin.layout import LayoutError


def load_model(root: Path, name: str) -> mujoco.MjSpec:
    """One model file, after a check that all it names lies inside `root`.

    Raises:
        LayoutError: one line naming the file and what is wrong with it.
    """
    path = root / name
    _check_files(path, root.resolve())
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise LayoutError(f"{path}: {str(error).splitlines()[0]}") from None


def _check_files(path: Path, root: Path) -> None:
    try:
        tree = ElementTree.parse(path).getroot()
    except OSError:
        raise LayoutError(f"{path}: model file is missing") from None
    except ElementTree.ParseError as error:
        raise LayoutError(f"{path}: not an MJCF file ({error})") from None
    compiler = tree.find("compiler")
    folders = {} if compiler is None else compiler.attrib
    assets = folders.get("assetdir", "")
    for element in tree.iter():
        file = element.get("file")
        if file is None:
            continue
        by_kind = {"mesh": "meshdir", "texture": "texturedir"}.get(element.tag, "")
        folder = "" if element.tag in ("include", "model") else folders.get(by_kind, assets)
        target = (path.parent / folder / file).resolve()
        if not target.is_relative_to(root):
            raise LayoutError(f"{path}: '{file}' lies outside the models' folder {root}")
        if not target.is_file():
            raise LayoutError(f"{path}: '{file}' is missing")
        if element.tag in ("include", "model"):
            _check_files(target, root)
