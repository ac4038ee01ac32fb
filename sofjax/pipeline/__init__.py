"""A drive in, its result out: what the command line prints, as a library."""
