"""What measures: sweeps, comparisons, reports, gaps and benchmarks. Importing this package imports no torch."""
