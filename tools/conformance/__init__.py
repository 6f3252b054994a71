"""The vectors of tests/conformance: small streams that a decoder of docs/spec plays or refuses, made one by one.

Usage: python -m tools.conformance [--verify]
"""
