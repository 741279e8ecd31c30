"""The paper's measures over all benchmark data, by one command: `cgf evaluate --suite paper`.

`sets` says which pairs, `rows` which descriptors, `scoring` what is measured of a pair; `running` goes through them and
keeps what is done; `summary` takes means; `report` and `plots` show them.
"""
