"""What is asked of the applications: frozen values in which all is decided.

A command turns its options into one of them, and whoever uses these applications from Python makes
them without any options. Devices are resolved, presets chosen, and options that exclude each other
refused by then. What only the data can tell, such as a context that nobody named, is None until
they are read. Nothing here needs torch.
"""
