"""For chains of requests (scripts/schemathesis): nothing is read as it was at a former revision, when it may have been there."""

import schemathesis


@schemathesis.hook
def filter_case(context, case) -> bool:
    return "revision" not in (case.query or {})
