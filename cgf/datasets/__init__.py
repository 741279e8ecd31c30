"""Data sets, one module each: `find_*` lists pairs without reading clouds, `load_*` reads them one after another."""
