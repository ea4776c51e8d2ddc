"""Identity on the radio: members, signed envelopes, and refusal of all other messages."""
