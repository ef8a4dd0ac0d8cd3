"""The suite behind other libraries' APIs, one module each; what death means to all of them is in `death`."""
