"""Hashes (RIHS01) by ROS 2's own generator (rosidl), of types whose packages are not installed here.

Argument: a file with a JSON object, {"package/msg/Name": text of its file, "package/action/Name": …}. Prints
what it found as a line of JSON."""

import json
import sys
import tempfile
from pathlib import Path

from rosidl_adapter.action import convert_action_to_idl
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_type_description import generate_type_hash

SHARE = Path(sys.prefix) / "share"
CONVERT = {"msg": convert_msg_to_idl, "action": convert_action_to_idl}

texts = json.loads(Path(sys.argv[1]).read_text())
found = {}
with tempfile.TemporaryDirectory() as folder:
    for package in sorted({name.split("/")[0] for name in texts}):
        source, made = Path(folder, package), Path(folder, "made", package)
        idls = []
        for name, text in texts.items():
            of, kind, type_ = name.split("/")
            if of != package:
                continue
            path = Path(kind, f"{type_}.{kind}")
            (source / kind).mkdir(parents=True, exist_ok=True)
            (source / path).write_text(text)
            CONVERT[kind](source, package, path, source / kind)
            idls.append(f"{source}:{path.with_suffix('.idl')}")
        include = [f"{one.name}:{one}" for one in SHARE.iterdir() if list(one.glob("*/*.json"))]
        made.mkdir(parents=True)
        arguments = Path(folder, f"{package}.json")
        arguments.write_text(
            json.dumps(
                {
                    "package_name": package,
                    "output_dir": str(made),
                    "idl_tuples": idls,
                    "include_paths": include,
                }
            )
        )
        for one in generate_type_hash(str(arguments)):
            hashes = json.loads(Path(one).read_text())["type_hashes"]
            found |= {each["type_name"]: each["hash_string"] for each in hashes}
print(json.dumps({"kind": "hashes", "of": found}))
