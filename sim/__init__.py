"""N robots in one process, each with its own perception, mailbox, policy and clock."""
