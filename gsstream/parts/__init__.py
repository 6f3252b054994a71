"""The swappable parts: one package for each slot, with the contract in ``base`` and the null part beside it."""
