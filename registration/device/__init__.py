"""Registration of clouds by torch alone, many at once, on a processor or a GPU."""
