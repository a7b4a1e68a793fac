# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Seeded mutations of bags of sqlite3: rows, tables, pages, values inside of messages."""

from contextlib import closing
import sqlite3

from damage import cdr, file_of


def sqlite_rows(rng, bag):
    """Change rows and the schema by SQL."""
    odd = ["'text'", '17', 'NULL', "x''", "x'ff'", '-1', '9223372036854775807', '1e300',
           'zeroblob(100000)', "'\x1b[2J'", 'randomblob(300)']
    db = sqlite3.connect(file_of(bag))
    tables = {'messages': ('id', 'topic_id', 'timestamp', 'data'),
              'topics': ('id', 'name', 'type', 'serialization_format', 'offered_qos_profiles'),
              'message_definitions': ('topic_type', 'encoding', 'encoded_message_definition'),
              'schema': ('schema_version',)}
    for _ in range(rng.choice([1, 2, 5])):
        table = rng.choice([*tables, 'messages', 'messages'])
        column = rng.choice(tables[table])
        share = rng.choice(['1', 'rowid % 2', f'rowid = {rng.randrange(1, 3000)}',
                            f'abs(random()) % {rng.choice([20, 300])} = 0'])
        change = rng.choice([f'UPDATE OR IGNORE {table} SET {column} = {rng.choice(odd)} '
                             f'WHERE {share}', f'DELETE FROM {table} WHERE {share}',
                             f'ALTER TABLE {table} RENAME COLUMN {column} TO x',
                             f'DROP TABLE {table}', 'DROP INDEX timestamp_idx'])
        try:
            db.execute(change)
        except sqlite3.Error:
            continue
    db.commit()
    db.close()


def sqlite_values(rng, bag):
    """Change values inside of messages, in some rows or all, and leave the table as it is."""
    with sqlite3.connect(file_of(bag)) as db:
        share = rng.choice([0.002, 0.05, 1.0])
        rows = [row for row in db.execute('SELECT id, data FROM messages') if rng.random() < share]
        db.executemany('UPDATE messages SET data = ? WHERE id = ?',
                       [(cdr(rng, data), key) for key, data in rows])
    db.close()


COLUMNS = ('id', 'topic_id', 'timestamp', 'data')
TABLES = [          # other tables with the same rows
    'CREATE TABLE other (data BLOB, timestamp INTEGER, topic_id INTEGER, id INTEGER PRIMARY KEY)',
    'CREATE TABLE other (id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB, '
    'PRIMARY KEY (timestamp, id)) WITHOUT ROWID',
    'CREATE TABLE other (id, topic_id, timestamp, data)',
    'CREATE TABLE other (id TEXT, topic_id TEXT, timestamp TEXT, data TEXT)',
    'CREATE TABLE other (id INTEGER PRIMARY KEY DESC, more BLOB DEFAULT (zeroblob(70000)), '
    'topic_id INTEGER, timestamp REAL, data BLOB)',
    'CREATE TABLE other (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB, '
    'twice AS (timestamp * 2) STORED)']
CHANGES = [
    'CREATE VIEW messages AS SELECT * FROM other', 'ALTER TABLE other RENAME TO messages',
    'ALTER TABLE other RENAME TO "Messages"', 'INSERT INTO messages SELECT '
    f'{", ".join(COLUMNS)} FROM other']
ROWS = ['id, topic_id, timestamp, data', '-id, topic_id, timestamp, data',
        'id + 9223372036854770000, topic_id, timestamp, data',
        "id, topic_id, timestamp, CAST(data || x'00' AS BLOB)"]


def sqlite_oddities(rng, bag):
    """Store the rows in a table, a view or a file as other writers of sqlite do."""
    file = file_of(bag)
    old = file.with_suffix('.old')
    file.rename(old)
    with closing(sqlite3.connect(old)) as read, (
            closing(sqlite3.connect(file, isolation_level=None))) as db:
        for pragma in (f'page_size = {rng.choice([512, 1024, 4096, 65536])}',
                       f'encoding = "{rng.choice(["UTF-8", "UTF-8", "UTF-16le", "UTF-16be"])}"',
                       f'auto_vacuum = {rng.choice([0, 1, 2])}',
                       f'journal_mode = {rng.choice(["delete", "wal"])}'):
            db.execute(f'PRAGMA {pragma}')
        db.execute('BEGIN')
        for name, sql in read.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table' "
                                      "AND name NOT LIKE 'sqlite_%'").fetchall():
            db.execute(sql)
            rows = read.execute(f'SELECT * FROM {name}').fetchall()
            if rows and name != 'messages':
                db.executemany(f'INSERT INTO {name} VALUES ({", ".join("?" * len(rows[0]))})',
                               rows)
        table, change = rng.choice(TABLES), rng.choice(CHANGES)
        if change.startswith(('ALTER', 'CREATE VIEW messages')):
            db.execute('DROP TABLE messages')
        db.execute(table)
        order = rng.choice(['timestamp', 'timestamp DESC', 'topic_id, id', 'random()'])
        db.executemany(f'INSERT OR IGNORE INTO other ({", ".join(COLUMNS)}) VALUES (?, ?, ?, ?)',
                       read.execute(f'SELECT {rng.choice([ROWS[0], *ROWS])} FROM messages ORDER '
                                    f'BY {order}'))
        db.execute(change)
        db.execute('COMMIT')
    old.unlink()


def sqlite_pages(rng, bag):
    """Change the headers of pages: kinds, cells, page numbers."""
    file = file_of(bag)
    data = bytearray(file.read_bytes())
    size = int.from_bytes(data[16:18], 'big')
    for _ in range(rng.choice([1, 3, 20])):
        page = rng.randrange(len(data) // size)
        at = page * size + (100 if page == 0 else 0) + rng.randrange(24)
        data[at] = rng.choice([0, 1, 2, 5, 10, 13, 255, rng.randrange(256)])
    file.write_bytes(data)
