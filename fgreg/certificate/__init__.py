"""A proof that no other registration explains the pairs as well."""
