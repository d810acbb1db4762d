"""The three checks of the VN-100's wire. Source: UM001 "Checksum / CRC" (vn100-protocol 1.1, 1.2).

* ASCII, 2 hex digits: XOR of all bytes between ``$`` and ``*``.
* ASCII, 4 hex digits, and binary: CRC-16/XMODEM (polynomial 0x1021, initial value 0), sent with the
  high byte first, so that the CRC over data and CRC together is 0.
"""

from __future__ import annotations

from binascii import crc_hqx

_AFTER_SYNC = 0xFA00  # from here the byte FA leads to 0: lets the CRC run over a packet with its FA
_FOLDED_BYTES = 128  # covers every line that a device streams


def xor8(body: bytes) -> int:
    """XOR of all bytes: the body as one long integer, folded in half until a byte is left."""
    if len(body) > _FOLDED_BYTES:
        return xor8(body[:_FOLDED_BYTES]) ^ xor8(body[_FOLDED_BYTES:])
    bits = int.from_bytes(body, "little")
    bits ^= bits >> 512
    bits ^= bits >> 256
    bits ^= bits >> 128
    bits ^= bits >> 64
    bits ^= bits >> 32
    bits ^= bits >> 16
    bits ^= bits >> 8
    return bits & 0xFF


def crc16(data: bytes) -> int:
    """CRC-16/XMODEM; ``crc16(b"123456789") == 0x31C3``."""
    return crc_hqx(data, 0)


def packet_intact(packet: bytes) -> bool:
    """Whether the CRC of a whole binary packet, sync byte FA to last CRC byte, is right."""
    return crc_hqx(packet, _AFTER_SYNC) == 0
