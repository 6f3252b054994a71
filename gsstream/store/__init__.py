"""What lies elsewhere: recordings that are fetched from a store of objects, and results that are brought there."""
