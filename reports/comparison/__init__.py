"""``headbench compare``: paired differences between methods, with what they allow one to say."""
