"""Helpers for all modules: checks of arguments, frozen arrays, executors, tables, HTML."""
