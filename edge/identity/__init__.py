"""Who speaks on the radio: cards, signed envelopes, and what is not a member's is not heard."""
