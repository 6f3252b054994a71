"""A module that forgot its hookimpl."""
