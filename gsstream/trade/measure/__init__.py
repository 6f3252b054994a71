"""What a run measured: its records, the quality of decoded frames, summaries, and where the bytes of a stream go."""
