"""The fleet from the workstation: releases, deployment over SSH, start and stop."""
