"""The one interface to a method, and the simplest of them."""
