"""The residual of a frame: how it lies in one table, what it decodes to, what it costs, and how it is trained."""
