"""How good a stream is: decoded frames against the recording; statistics, summary and pictures of a run."""
