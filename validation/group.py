"""Running one group of checks, in a process of its own."""

from dataclasses import replace
from importlib import import_module

import mitsuba as mi

from .report import Check
from .scenes import VARIANT, Effort


def run(name: str, effort: Effort) -> tuple[str, str, list[Check]]:
    """Title, introduction and checks of a group."""
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    group = import_module(f"validation.{name}")
    done = [replace(check(effort), name=f"{name}.{check.__name__}") for check in group.CHECKS]
    return group.TITLE, group.INTRODUCTION, done
