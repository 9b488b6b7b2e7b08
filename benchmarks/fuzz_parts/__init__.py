"""Parts of ``fuzz_requests.py``."""
