"""Identity on the radio: cards, signed envelopes, and refusal of what is not a member's."""
