"""The nouns: plain records of arrays. No policy, no input or output, no torch at import time."""
