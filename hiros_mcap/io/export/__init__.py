"""The result in messages that other tools draw by themselves."""
