"""Errors of winds on families of flows, half of which take part in no choice of a method."""

from .table import INTRODUCTION, TITLE, flows

__all__ = ["CHECKS", "INTRODUCTION", "TITLE"]

CHECKS = (flows,)
