"""The messages measured per protocol, and the usual package that encodes and decodes them as well."""
