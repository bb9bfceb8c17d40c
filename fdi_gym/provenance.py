"""What a result was made of: digests of the sources and of the data files that a method, its plant and the engine are.

Sources are followed through their imports, also those inside functions: every module of the method's own package, of this
one, and of files that lie outside the installed libraries. Data files are those that the method really opens when it is
built and shown a sample, or when its modules are imported; nothing needs to be declared.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import os
import sys
import sysconfig
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

import fdi_gym
from fdi_gym.diagnosis import Entry, diagnosers, find_diagnoser, make_diagnoser
from fdi_gym.diagnosis.knowledge import knowledge_of
from fdi_gym.diagnosis.registry import package_of
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import simulate
from fdi_gym.estimation.data import digest
from fdi_gym.faults import draw
from fdi_gym.metrics import outcome
from fdi_gym.names import blamed
from fdi_gym.plant import Plant

_LIBRARIES = tuple(Path(p).resolve() for p in {*sysconfig.get_paths().values(), sys.prefix, sys.base_prefix})
_SYSTEM = tuple(Path(p) for p in ("/proc", "/sys", "/dev", "/etc"))
_CODE = (".py", ".pyc", ".pyi", ".so", ".pyd", ".dll", ".dylib", ".nbi", ".nbc")  # sources are followed, the rest derived
_CHOOSERS = {"make_diagnoser", "find_diagnoser"}  # a method that calls one depends on methods that it finds by name


def provenance(name: str, plant: Plant, process: str, settings: Mapping[str, Any]) -> dict[str, str]:
    """Digests of all that a diagnoser's results on a plant depend on, beside the suite: see `made_of`."""
    return made_of(
        find_diagnoser(name), plant, process, settings, lambda: _use(name, plant, process, settings)
    )  # fmt: skip


def made_of(
    entry: Entry, plant: Plant, process: str, settings: Mapping[str, Any], use: Callable[[], Any], flown: str = ""
) -> dict[str, str]:
    """Digests of all that a method's results on a plant depend on, beside the suite: one per kind.

    Args:
        entry: The diagnoser or prober.
        plant: The plant.
        process: The fault process that it meets.
        settings: What its builder gets.
        use: Builds the method and uses it once: whatever it reads, compiles or calibrates is read, compiled, calibrated.
        flown: The module that flies, where the method acts on its flights.

    Returns:
        SHA-256 of "method", "plant" and "engine" (their modules), of "belief" and "calibration" where the method takes
        them, and of "data" where the method or the plant reads files.

    Raises:
        ValueError: The method cannot be built; `NotApplicableError` where it cannot run on this plant.
    """
    build, name = entry.build, entry.name
    method = sources({build.__module__, name.partition(":")[0] if ":" in name else build.__module__})
    declared = sources({plant_sources()[plant.id].builder.partition(":")[0]}) if plant.id in plant_sources() else {}
    engine = sources({simulate.__module__, outcome.__module__, *([flown] if flown else [])})
    key = (name, plant.env_id, repr(sorted(plant.options.items())), repr(sorted(settings.items())))
    read = _while_running(key, lambda: (_load(plant), use()))
    own = {**method, **declared}
    read |= {path for file in own.values() for path in _at_import.get(str(file), ())}
    home = package_of(entry)
    known = () if home is None else (home / "fits", home / "tuning")  # which the digests of knowledge and settings cover
    data = {path for path in read if _is_data(path, own) and path.parent not in known}
    found = {"method": _digest(method), "plant": _digest(declared), "engine": _digest(engine)}
    found |= {kind: digest(what) for kind, what in knowledge_of(entry, plant, process, settings).items()}
    return found | ({"data": _digest({str(p): p for p in data}, by_name=False)} if data else {})


def packages(entry: Entry, plant: Plant) -> dict[str, str]:
    """The packages of a method, its plant and the engine, as "name version": one per kind.

    Modules that no installed package brings, such as one in the current folder, have none.
    """
    source = plant_sources().get(plant.id)
    modules = {
        "method": entry.build.__module__,
        "plant": source.builder if source else "",
        "engine": "fdi_gym",
    }
    found = {kind: _package(module.partition(":")[0].partition(".")[0]) for kind, module in modules.items()}
    return {kind: said for kind, said in found.items() if said}


@functools.cache
def _package(module: str) -> str:
    """The package that brings a top-level module, as "name version"; "" where none does.

    One that is installed in editable mode is known by its plugins, one that is not installed by the project file beside it.
    """
    if module == "fdi_gym":
        return f"fdi-gym {fdi_gym.__version__}"
    for group in ("fdi_gym.diagnosers", "fdi_gym.plants", "fdi_gym.suites"):
        for point in metadata.entry_points(group=group):
            if point.value.partition(":")[0].partition(".")[0] == module and point.dist is not None:
                return f"{point.dist.name} {point.dist.version}"
    names = metadata.packages_distributions().get(module, [])
    if names:
        return f"{names[0]} {metadata.version(names[0])}"
    file = _file_of(module)
    if file is None or file.name != "__init__.py":
        return ""
    home = file.parents[2] if file.parents[1].name == "src" else file.parents[1]
    try:
        project = tomllib.loads((home / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        return f"{project['name']} {project['version']}"
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _load(plant: Plant) -> None:
    """Build a plant again, for what its builder reads."""
    if plant.id in plant_sources():
        load_plant(plant.id, **plant.options)


def _use(name: str, plant: Plant, process: str, settings: Mapping[str, Any]) -> None:
    """Build a diagnoser and show it one sample."""
    scenarios, obs = None, np.array([[s.nominal for s in plant.observed]])
    if plant.kernels is not None:
        scenarios = [draw(plant.process(process), 0)]
        obs = simulate(plant, scenarios).obs[:, 0]
    with blamed(name):
        diagnoser = make_diagnoser(name, plant, process=process, scenarios=scenarios, **settings)
        diagnoser.update(diagnoser.init(1), obs)


def _digest(files: Mapping[str, Path], by_name: bool = True) -> str:
    """Digest of files: of modules with their names, of data files by content alone, wherever they lie."""
    parts = []
    for name, path in files.items():
        content = path.read_bytes()
        content = content.replace(b"\r\n", b"\n") if by_name else content
        parts.append(f"{name if by_name else ''} {hashlib.sha256(content).hexdigest()}")
    return hashlib.sha256("\n".join(sorted(parts)).encode()).hexdigest()


# ---------------------------------------------------------------------------------------------------------------
# Sources


def sources(modules: Iterable[str]) -> dict[str, Path]:
    """The files of modules and of all that they import, directly or not, by module name; libraries are left out."""
    todo, found = list(modules), {}
    own = {name.split(".")[0] for name in todo} | {"fdi_gym"}
    while todo:
        name = todo.pop()
        file = None if name in found else _file_of(name)
        if file is None or not (name.split(".")[0] in own or not _is_library(file)):
            continue
        found[name] = file
        imported, chooses = _imports(file, name if file.stem == "__init__" else name.rpartition(".")[0])
        todo += [*imported, *_parents(name)]
        if chooses and not name.startswith("fdi_gym."):
            todo += [entry.build.__module__ for entry in diagnosers().values()]
    return found


def _parents(name: str) -> Iterator[str]:
    while name := name.rpartition(".")[0]:
        yield name


def _is_library(file: Path) -> bool:
    installed = "site-packages" in file.parts or "dist-packages" in file.parts  # also another environment's, on the path
    return installed or any(file.is_relative_to(folder) for folder in _LIBRARIES)


def _file_of(name: str) -> Path | None:
    """The source file of a module, without importing it."""
    top = name.split(".")[0]
    if top in sys.stdlib_module_names or top == "builtins":
        return None
    origin: str | None = None
    if name == "__main__":
        origin = getattr(sys.modules[name], "__file__", None)
    else:
        try:
            spec = importlib.util.find_spec(name)
            origin = spec.origin if spec else None
        except Exception:  # whatever a package does when it is imported
            origin = None
    return Path(origin).resolve() if origin and origin.endswith(".py") and Path(origin).is_file() else None


def _imports(file: Path, package: str) -> tuple[list[str], bool]:
    """What a file imports, by absolute name, and whether it finds diagnosers by name."""
    return _parsed(file.read_bytes(), package)


@functools.lru_cache(maxsize=1024)
def _parsed(text: bytes, package: str) -> tuple[list[str], bool]:
    names, chooses = [], False
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Import():
                names += [alias.name for alias in node.names]
            case ast.ImportFrom():
                base = package.rsplit(".", node.level - 1)[0] if node.level else ""
                origin = ".".join(part for part in (base, node.module) if part)
                names += [origin, *(f"{origin}.{alias.name}" for alias in node.names)]
                chooses |= any(alias.name in _CHOOSERS for alias in node.names)
            case ast.Call(func=ast.Attribute(attr="import_module"), args=[ast.Constant(value=str(name)), *_]):
                names.append(name)
            case ast.Call(
                func=ast.Attribute(attr="import_module"),
                args=[ast.JoinedStr(values=[ast.Constant(value=str(prefix)), *_]), *_],
            ) if prefix.endswith("."):  # one of a package's modules, whichever
                names += _modules_of(prefix[:-1])
            case ast.Attribute(attr=attribute) if attribute in _CHOOSERS:
                chooses = True
    return names, chooses


def _modules_of(package: str) -> list[str]:
    file = _file_of(package)
    return [package, *(f"{package}.{path.stem}" for path in file.parent.glob("*.py"))] if file else []


# ---------------------------------------------------------------------------------------------------------------
# Data files: an audit hook sees every file that is opened; kept is what a method's code opens

_at_import: dict[str, set[Path]] = {}  # by source file: what it reads while it is imported
_read: dict[Any, set[Path]] = {}  # by method, plant and settings: what was read so far, since methods may keep it
_running: set[Path] | None = None


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if event != "open" or not isinstance(arguments[0], (str, bytes)):
        return
    path, mode, flags = arguments
    path = os.fsdecode(path)
    reads = mode in ("r", "rb", "rt") if mode else flags & (os.O_WRONLY | os.O_RDWR) == 0
    if not reads or path.endswith(_CODE):
        return
    frame: Any = sys._getframe(1)
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib"):
            return  # a library that is imported reads what it needs
        if code.co_name == "<module>" and frame.f_back and frame.f_back.f_code.co_filename.startswith("<frozen importlib"):
            _at_import.setdefault(os.path.realpath(code.co_filename), set()).add(Path(path).absolute())
            return
        if code is _while_running.__code__ and _running is not None:
            _running.add(Path(path).absolute())
            return
        frame = frame.f_back


sys.addaudithook(_hook)


def _while_running(key: Any, function: Callable[[], Any]) -> set[Path]:
    """The files that a function has opened for reading, in this call and in earlier ones for the same key."""
    global _running
    before, _running = _running, _read.setdefault(key, set())
    try:
        function()
        return set(_running)
    finally:
        _running = before


def _is_data(path: Path, modules: Mapping[str, Path]) -> bool:
    """Whether a file that was opened is a method's or plant's own and still there: no library's, system's or cache's."""
    path = path.resolve()
    cache = Path(os.environ.get("FDI_GYM_CACHE_DIR") or platformdirs.user_cache_path("fdi_gym")).resolve()
    if not path.is_file() or any(path.is_relative_to(folder) for folder in (*_SYSTEM, cache)):
        return False
    if path.parent.suffix in (".dist-info", ".egg-info"):  # an installed package's description
        return False
    packages = [file.parent for file in modules.values() if file.stem == "__init__"]
    return not _is_library(path) or any(path.is_relative_to(folder) for folder in packages)
