"""Result and annotation files, read and written."""
