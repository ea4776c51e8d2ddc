"""The documentation site: the repository's pages, and reference pages made from the code.

`python -m handbook` builds it. `pages` gathers everything; `commands`, `configuration`, `messages`
and `interfaces` write the reference, so that it cannot drift from what the code does.
"""
