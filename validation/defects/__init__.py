"""Errors of winds from images that break what retrievals assume of them, by families of defects."""

from .table import INTRODUCTION, TITLE, defects

__all__ = ["CHECKS", "INTRODUCTION", "TITLE"]

CHECKS = (defects,)
