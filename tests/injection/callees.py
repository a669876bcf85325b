"""Which library a called object belongs to, and what it is called there."""

from __future__ import annotations

import io
import sys
from functools import cache
from types import ModuleType
from typing import Any

LIBRARIES = ("cv2", "scipy", "numpy.linalg", "torch", "onnxruntime")
FILE_LIBRARIES = ("mcap", "rosbags", "PIL", "shutil", "zipfile", "socketserver")
"""Libraries of which every call is counted as a file operation."""

FILE = "file"
PATH_METHODS = {
    *("open", "read_bytes", "read_text", "write_bytes", "write_text", "touch", "unlink", "rename"),
    *("replace", "mkdir", "rmdir", "iterdir", "glob", "rglob", "stat", "exists", "is_file"),
    *("is_dir", "resolve", "chmod", "symlink_to"),
}
OS_FUNCTIONS = {
    *("open", "close", "fsync", "replace", "rename", "remove", "unlink", "mkdir", "makedirs"),
    *("rmdir", "stat", "statvfs", "listdir", "scandir", "read", "write", "chmod", "symlink"),
}
STREAM_METHODS = {
    *("read", "readline", "readlines", "readinto", "write", "writelines", "flush", "close"),
    *("seek", "tell", "fileno", "truncate"),
}
NUMPY_FILES = {"save", "savez", "savez_compressed", "load", "fromfile", "loadtxt", "tofile"}
JSON_FILES = {"load", "dump"}
NAMED = {
    "pathlib": PATH_METHODS, "posix": OS_FUNCTIONS, "os": OS_FUNCTIONS,
    "numpy": NUMPY_FILES, "json": JSON_FILES,
}  # fmt: skip
"""By module: what reads or writes files."""
WRITES = {"write", "writelines", "flush", "close", "fsync", "mkdir", "makedirs", "replace", "open"}
WRITES |= {"write_bytes", "write_text", "touch", "tofile", "savez", "savez_compressed", "save"}


def library_of(callee: Any) -> tuple[str, str] | None:
    """Library and qualified name of what our code calls; None for what is not injected."""
    name = _opencv_names().get(id(callee))
    if name is not None:
        return "cv2", name
    module, name = _module_and_name(callee)
    for library in LIBRARIES:
        if module == library or module.startswith(f"{library}."):
            return library, f"{_public(module)}.{name}"
    return (FILE, f"{module}.{name}") if _is_file(callee, module, name) else None


def is_write(name: str) -> bool:
    """True for a file operation that a full disk can refuse."""
    return name.rpartition(".")[2] in WRITES


def _is_file(callee: Any, module: str, name: str) -> bool:
    last = name.rpartition(".")[2]
    if module in NAMED:
        return last in NAMED[module]
    if module in ("io", "_io"):
        return name == "open" or (last in STREAM_METHODS and _is_on_disk(callee))
    return module.partition(".")[0] in FILE_LIBRARIES


def _is_on_disk(callee: Any) -> bool:
    stream = getattr(callee, "__self__", None)
    in_memory = isinstance(stream, (io.BytesIO, io.StringIO))
    return not in_memory and stream not in (sys.stdout, sys.stderr)


def _module_and_name(callee: Any) -> tuple[str, str]:
    owner = getattr(callee, "__self__", None)
    name = str(getattr(callee, "__qualname__", type(callee).__qualname__))
    module = getattr(callee, "__module__", None)
    if owner is not None and not isinstance(owner, ModuleType):
        cls = owner if isinstance(owner, type) else type(owner)
        function = getattr(callee, "__func__", None)
        # A method that a subclass of ours inherits is the library's.
        module = cls.__module__ if function is None else function.__module__
    elif module is None:
        module = type(callee).__module__
    return str(module), name


def _public(module: str) -> str:
    """Without the private parts: 'torch._C' is 'torch'."""
    return ".".join(part for part in module.split(".") if not part.startswith("_"))


@cache
def _opencv_names() -> dict[int, str]:
    """By id: OpenCV's functions, which know neither their module nor their class."""
    import cv2

    names: dict[int, str] = {}
    for module_name, module in list(sys.modules.items()):
        if module_name == "cv2" or module_name.startswith("cv2."):
            for name, value in vars(module).items():
                if type(value).__name__ == "builtin_function_or_method":
                    names[id(value)] = f"{module_name}.{name}"
                elif isinstance(value, type):
                    names |= {
                        id(static): f"{module_name}.{name}.{key}"
                        for key in dir(value)
                        if type(static := getattr(value, key)).__name__
                        == "builtin_function_or_method"
                        and getattr(static, "__self__", None) is None
                    }
    assert names, cv2
    return names
