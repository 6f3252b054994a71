"""One small complete part per kind: what saboteurs spoil, and what ``gsstream new-plugin`` starts an author with."""
