"""placeholder"""


def page(f):
    import json

    return json.dumps(f, indent=0)[:500]
