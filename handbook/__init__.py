"""Builds the documentation site: the repository's pages, and reference pages from the code.

`python -m handbook` builds it. `pages` gathers all pages; `commands`, `configuration`,
`faults`, `interfaces` and `messages` generate the reference.
"""
