"""Cases times methods: what is run, resumed and kept."""
