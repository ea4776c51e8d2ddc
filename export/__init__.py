"""Export of a torch checkpoint to a bundle. The only package that imports torch."""
