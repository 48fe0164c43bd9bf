"""YAML of others: as their own readers take it (YAML 1.1), but no key twice."""

from __future__ import annotations

from typing import Any

import yaml

from gripmon.calibrate.interchange.fault import InterchangeError


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    pass


class _Twice(Exception):
    def __init__(self, key: str, line: int):
        super().__init__(key)
        self.key, self.line = key, line


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[str, Any]:
    keys = [str(key.value) for key, _ in node.value]
    for i, (key, _) in enumerate(node.value):
        if keys[i] in keys[:i]:
            raise _Twice(keys[i], key.start_mark.line + 1)
    return {str(k): v for k, v in loader.construct_pairs(node, deep=True)}


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)


def read_mapping(file: str, data: bytes, right: str) -> dict[str, Any]:
    """The mapping in a file's bytes; ``right`` says what kind of file it should be."""
    try:
        value = yaml.load(data.decode("utf-8-sig"), _Loader)
    except UnicodeDecodeError as error:
        raise InterchangeError(file, "", f"is not text (byte {error.start} is not UTF-8)", right) from None
    except _Twice as error:
        raise InterchangeError(file, f"line {error.line}", f"the key '{error.key}' is there twice", "once") from None
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InterchangeError(
            file, line, f"not YAML: {error.problem or error.context or 'malformed'}", right
        ) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InterchangeError(file, "", f"not YAML: {error}", right) from None
    if not isinstance(value, dict):
        raise InterchangeError(file, "", "is empty" if value is None else "holds no keys", right)
    return value
