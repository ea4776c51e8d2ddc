"""Identity on the radio: members, signed envelopes, and refusal of what is not a member's."""
