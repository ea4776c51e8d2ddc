"""From what was recorded of a flight to numbers, figures and a page."""
