"""The live page: what a browser on this machine shows of a twin."""
