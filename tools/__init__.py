"""Jobs that only developers run, from the root of the repository; they are no part of the distribution."""
