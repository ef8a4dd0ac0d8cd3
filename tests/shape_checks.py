"""The type checker behind the shape checks: beartype, with int accepted where float is asked for."""

import beartype

check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
