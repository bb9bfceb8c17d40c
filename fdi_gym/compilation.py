"""Kernels compiled by several processes at once, before any of them is needed: each then finds all of them in the cache."""

from __future__ import annotations

import importlib
from collections.abc import Collection
from typing import Any

import joblib
from tqdm import tqdm

from fdi_gym.kernels import load, uncompiled


def compile_kernels(modules: Collection[str], jobs: int = -1, progress: bool = True) -> None:
    """Compile what the cache lacks of the kernels of some modules, as far as these are imported.

    Args:
        modules: Their names.
        jobs: Worker processes, -1 for one per core.
        progress: Show a progress bar.
    """
    # those with the most arguments take the longest: these first
    missing = sorted(uncompiled(modules), key=lambda kernel: -kernel.py_func.__code__.co_argcount)
    if len(missing) < 2:
        return
    parallel: Any = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
    with tqdm(total=len(missing), desc="compiling, once", unit="kernel", disable=not progress, leave=False) as bar:
        for _ in parallel(joblib.delayed(_compile)(k.py_func.__module__, k.py_func.__name__) for k in missing):
            bar.update()


def _compile(module: str, name: str) -> None:
    load(getattr(importlib.import_module(module), name))
