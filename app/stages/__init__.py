"""The stages of a twin, each from the configuration and what the stage before left in the folder."""
