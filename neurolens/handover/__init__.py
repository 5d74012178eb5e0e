"""A lens as files of the programs that follow a render: one module a standard; their texts are templates."""
